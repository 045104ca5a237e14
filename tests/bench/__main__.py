"""Everything `make bench` prints."""

import argparse

from tests.bench import matching, pipeline, refining, regional, terrain

about = "All benchmarks, ten minutes and more; python -m tests.bench.NAME runs one."
argparse.ArgumentParser("python -m tests.bench", description=about).parse_args()
matching.main()
refining.main()
pipeline.main()
for scene in ("gravel", "mixed"):
    terrain.main(["--scene", scene, "--stride", "10"])
regional.main()
