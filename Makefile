# Everything is installed by pip into .venv; nothing else is needed but Linux, make and Python 3.11 or newer with venv.
PYTHON ?= python3
BIN := .venv/bin
CONSTRAINTS ?= constraints.txt
PIP_INSTALL = $(BIN)/python -m pip install --disable-pip-version-check --no-compile --constraint $(CONSTRAINTS)
QUICK := (not slow or essential) and not full and not browser and not peers

# A step of the set-up in one line; what its command prints is shown only if it fails.
step = @echo "$(1)"; mkdir -p build; \
	{ $(2); } > build/set-up.log 2>&1 || { cat build/set-up.log; echo "The set-up failed; see above."; exit 1; }

.PHONY: demo test test-all test-full lint bench constraints newest wheel
demo: .venv/run
	@$(BIN)/greenough demo

test: .venv/test
	@$(BIN)/python -m pytest -n 2 --dist loadfile -m "$(QUICK)"

test-all: .venv/peers
	@$(BIN)/python -m pytest -n 2 --dist loadfile -m "not full"

test-full: .venv/test
	@$(BIN)/python -m pytest -m full

lint: .venv/test .venv/lint
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	rm -rf build/types && mkdir -p build/types/greenough
	for package in instrument pipeline scenes twin; do ln -s ../../../$$package build/types/greenough/$$package; done
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(BIN)/lint-imports

bench: .venv/bench
	@$(BIN)/greenough bench

# One known set of versions for everybody, from the newest that pip finds today.
constraints:
	rm -rf build/newest
	$(PYTHON) -m venv build/newest
	build/newest/bin/pip install --quiet --upgrade pip
	build/newest/bin/pip install --quiet --editable '.[bench,dev]'
	{ echo "# Versions that are known to work together: \`make constraints\` writes this file, \`make newest\` ignores it."; \
	  build/newest/bin/pip freeze --exclude-editable; } > constraints.txt

# The tests with the newest version of everything, in an environment of their own.
newest:
	rm -rf build/newest
	$(PYTHON) -m venv build/newest
	build/newest/bin/pip install --quiet --upgrade pip
	build/newest/bin/pip install --quiet --editable '.[dev]'
	build/newest/bin/python -m pytest -n 2 --dist loadfile -m "not full"

# The wheel, installed beside nothing of this folder, answers from an empty one.
wheel: .venv/run
	@.ci/wheel

.venv/made:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "Greenough needs Python 3.11 or newer, and $(PYTHON) is older or missing: say PYTHON=python3.12, or whatever yours is called."; \
	  exit 2; }
	$(call step,Making a Python environment in .venv,$(PYTHON) -m venv .venv)
	@touch $@

.venv/run: .venv/made pyproject.toml constraints.txt
	$(call step,Installing Greenough and what it runs on,$(PIP_INSTALL) --editable .)
	@touch $@

.venv/test: .venv/run
	$(call step,Installing what the tests need,$(PIP_INSTALL) --editable '.[test]')
	@touch $@

.venv/lint: .venv/run
	$(call step,Installing what checks the code,$(PIP_INSTALL) --editable '.[lint]')
	@touch $@

.venv/peers: .venv/test
	$(call step,Installing the programs that the tests compare with,$(PIP_INSTALL) --editable '.[peers]')
	@touch $@

# The peer `fringes` would install an OpenCV of its own over ours.
.venv/bench: .venv/run
	$(call step,Installing the programs that the benchmark compares with,$(PIP_INSTALL) --editable '.[bench]' \
	  && $(PIP_INSTALL) --no-deps fringes==2.1.0)
	@touch $@
