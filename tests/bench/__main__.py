"""Everything `make bench` prints."""

from tests.bench import matching, pipeline

matching.main()
pipeline.main()
