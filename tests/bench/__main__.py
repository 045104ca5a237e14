"""Everything `make bench` prints."""

from tests.bench import pipeline

pipeline.main()
