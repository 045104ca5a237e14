"""Everything `make bench` prints."""

import argparse

from tests.bench import decoding, fleet, large_log, matching, pipeline, refining, regional, start, terrain, weak_texture

about = "All benchmarks, over half an hour; python -m tests.bench.NAME runs one."
argparse.ArgumentParser("python -m tests.bench", description=about).parse_args()
decoding.main()
large_log.main([])
matching.main()
refining.main()
pipeline.main([])
start.main([])
weak_texture.main(["--frames", "1"])
terrain.main(["--stride", "10"])
regional.main()
fleet.main([])
