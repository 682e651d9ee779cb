# `make demo` and `make test` are all a newcomer needs: each sets up .venv first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PEERS := .peers
DEMO_OUT ?= demo-out

.PHONY: setup peers demo test test-all lint format benchmarks bench validation docs models any-camera lock clean

setup: $(VENV)/.ready

$(VENV)/.ready: pyproject.toml requirements.lock
	$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(v < (3, 11) and f"tapetum needs Python 3.11 or newer, this is {v.major}.{v.minor}: set PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c requirements.lock -e '.[dev]'
	@touch $@

# Optiland, the ray tracer that the lenses are compared with: 840 MB that only some tests need.
peers: $(VENV)/.peers $(PEERS)/.ready

# TrackEval, the reference code of scores of tracks, which wants its own versions of what we use too.
$(PEERS)/.ready:
	$(PYTHON) -m venv $(PEERS)
	$(PEERS)/bin/python -m pip install --quiet --disable-pip-version-check trackeval==1.3.0
	@touch $@

$(VENV)/.peers: $(VENV)/.ready
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c requirements.lock -e '.[zemax]'
	@touch $@

demo: setup
	$(BIN)/tapetum demo --out $(DEMO_OUT) --overwrite

# One test file a process, one thread each: as many processes as there are cores, the longest files first
# (tests/conftest.py).
TESTS := -n auto --dist loadfile --no-loadscope-reorder
# Processes that tests start would each compile the package where no bytecode may be kept.
ALONE := PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1

test: setup
	$(ALONE) $(BIN)/python -m pytest $(TESTS)

test-all: peers
	$(ALONE) $(BIN)/python -m pytest $(TESTS) -m 'slow or not slow'

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

format: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

benchmarks: setup
	$(BIN)/python -m benchmarks

# Its old name, for one release: `tapetum.bench` and `serve bench` are something else.
bench: benchmarks

# docs/validation.md, from the numbers that the tests check (some minutes).
validation: peers
	$(BIN)/python scripts/make_validation.py

docs: setup
	$(BIN)/mkdocs build --strict

# The bundled ResNet-18: films and trains (a quarter of an hour on 16 cores and a GPU, hours on 2 cores).
models: setup
	$(BIN)/python scripts/make_models.py

# A network that has seen many cameras (minutes on 16 cores and a GPU, hours on 2 cores); an interrupted run goes on.
any-camera: setup
	$(BIN)/python scripts/make_any_camera.py

# Rewrites requirements.lock; needs uv (a pip-installable tool). A local build's suffix (+cpu) must not be locked.
lock:
	echo 'torch==2.13.0' > .torch-pin
	uv pip compile --quiet --all-extras --no-annotate --no-header --constraint .torch-pin pyproject.toml \
		| sed 's/+cpu//' > requirements.lock.new
	rm .torch-pin
	mv requirements.lock.new requirements.lock

clean:
	rm -rf $(VENV) $(PEERS) $(DEMO_OUT) site .pytest_cache .ruff_cache .hypothesis build dist
