"""Everything `make bench` prints."""

from tests.bench import matching, pipeline, terrain

matching.main()
pipeline.main()
terrain.main(["--stride", "10"])
