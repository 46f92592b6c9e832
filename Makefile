# make demo        build the bundled real scene, drive it, write pictures and point clouds
# make test        the tests to run before a commit
# make test-all    all tests; those of the web page need chromium and chromedriver, and are skipped without
# make test-gpu    the kernels of CUDA on the CPU; installs the extra gpu
# make fuzz        property tests with fresh random seeds and ten times the examples; 20,000 damaged files
# make bench       benchmark against references, in bench/; options in ARGS, such as ARGS="--only casting writing"
# make bench-quick the same on a part of the demo, a few minutes
# make lint        style, types, layer contract
# make docs        the documentation as a site, in build/site; broken links are errors
# make wheel-test  build sdist and wheel, and run the installed wheel away from the repository
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# One worker process per core; all tests of a file run in one worker, so that they share what they record.
# Files start in the order of tests/conftest.py.
PYTEST := $(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder
# Tests and benchmarks start many processes, each of which would compile the packages to bytecode.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-all test-gpu fuzz bench bench-quick lint docs wheel-test clean

$(STAMP): requirements.lock pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed; name one: make PYTHON=python3.12")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	touch $@

demo: $(STAMP)
	$(BIN)/python examples/demo.py

test: $(STAMP)
	$(BIN)/python -m geoscene.support.kernels
	$(PYTEST) -m "not full"

test-all: $(STAMP)
	$(BIN)/python -m geoscene.support.kernels
	$(PYTEST)

test-gpu: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check warp-lang==1.19.0
	$(PYTEST) tests/lidar/raycast/test_warp.py tests/lidar/sensors/camera/test_warp_shade.py

fuzz: $(STAMP)
	$(PYTEST) --hypothesis-profile=fuzz -m hypothesis
	PYTHONPATH=benchmarks $(BIN)/python benchmarks/robustness.py --count 20000 --reading 0.97 --seed "$$(date +%s)"

bench: $(STAMP)
	PYTHONPATH=benchmarks $(BIN)/python -m bench $(ARGS)

bench-quick: $(STAMP)
	PYTHONPATH=benchmarks $(BIN)/python -m bench --quick $(ARGS)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

wheel-test: $(STAMP)
	$(BIN)/python -P tests/wheel.py

clean:
	rm -rf $(VENV) demo bench build dist *.egg-info
