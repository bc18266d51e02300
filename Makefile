# Everything is installed by pip into .venv; nothing else is needed but Python >= 3.11.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test test-full lint bench
demo: .venv/ready
	$(BIN)/greenough demo

test: .venv/ready
	$(BIN)/pytest -n 2 --dist loadfile

test-full: .venv/ready
	$(BIN)/pytest -m full

lint: .venv/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	rm -rf build/types && mkdir -p build/types/greenough
	for package in instrument pipeline scenes twin; do ln -s ../../../$$package build/types/greenough/$$package; done
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(BIN)/lint-imports

bench: .venv/bench
	$(BIN)/greenough bench

# The peer would install an OpenCV of its own over ours.
.venv/bench: .venv/ready
	$(BIN)/pip install --quiet --editable '.[bench]'
	$(BIN)/pip install --quiet --no-deps fringes==2.1.0
	touch $@

.venv/ready: pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --upgrade pip setuptools
	$(BIN)/pip install --quiet --editable '.[dev]'
	touch $@
