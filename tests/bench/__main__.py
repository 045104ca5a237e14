"""Everything `make bench` prints."""

from tests.bench import matching, pipeline, refining, regional, terrain

matching.main()
refining.main()
pipeline.main()
terrain.main(["--stride", "10"])
regional.main()
