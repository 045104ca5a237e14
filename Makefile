# Everything happens in .venv; the first target that needs it makes it.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready
# Tests start many processes; without kept bytecode each of them compiles the sources again.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo test check-all bench fuzz study pictures docs lint clean

demo: $(READY)
	$(BIN)/roverflow demo --out demo

test: $(READY)
	$(BIN)/python -m pytest -n 2 --dist worksteal

check-all: $(READY) lint
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "" --hypothesis-profile=thorough

bench: $(READY)
	$(BIN)/python -m tests.bench

FUZZ_SECONDS ?= 60
fuzz: $(READY)
	$(BIN)/python -m tests.fuzz --seconds $(FUZZ_SECONDS)

study: $(READY)
	$(BIN)/python -m tests.study demo/study
	$(BIN)/python -m tests.error_against_time demo/study

pictures: $(READY)
	$(BIN)/python -m tests.pictures docs

docs: $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	$(BIN)/python -m tests.docs.generated
	$(BIN)/mkdocs build --strict

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/python -m pytest tests/test_house.py

$(READY): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 15) and "roverflow needs Python 3.11 to 3.14; set PYTHON=...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[test]'
	@touch $@

clean:
	rm -rf $(VENV) demo
