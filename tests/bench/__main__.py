"""Everything `make bench` prints."""

from tests.bench import pipeline, terrain

pipeline.main()
terrain.main()
