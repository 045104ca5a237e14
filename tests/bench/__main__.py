"""Everything `make bench` prints."""

from tests.bench import matching, pipeline, regional, terrain

matching.main()
pipeline.main()
terrain.main()
regional.main()
