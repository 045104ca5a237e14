"""Everything `make bench` prints."""

from tests.bench import matching, pipeline, refining, terrain

matching.main()
refining.main()
pipeline.main()
terrain.main(["--stride", "10"])
