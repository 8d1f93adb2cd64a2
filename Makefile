# Every target makes what it needs: a fresh machine with Python ≥ 3.11 is enough.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
PIP := -m pip install --quiet --disable-pip-version-check --no-deps
LOCKED := $(PIP) --no-compile --requirement
# The library is made in build, and compiled anew only where its sources have changed.
INPLACE := $(PIP) --no-build-isolation --editable .
CORE := core/backend.py CMakeLists.txt $(wildcard core/*.?pp core/include/*.h)
# Matrices are small: threads of a BLAS would only wait for each other.
export OPENBLAS_NUM_THREADS := 1
# Python compiles what is imported, once; pip would compile all that it installs, which takes as long as the rest.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help demo test test-long lint docs notebooks bench lock clean

help:
	@echo "make demo       fuse a recorded run, score it, draw it (into ./demo)"
	@echo "make test       the tests; three minutes on two cores"
	@echo "make test-long  statistics, soak tests, notebooks and every command of the documentation; twenty minutes"
	@echo "make lint       ruff and pyright"
	@echo "make docs       the documentation as a site (into ./site)"
	@echo "make notebooks  run the notebooks anew, in place"
	@echo "make bench      pumafuse against its peers and version 0.2 (into .venv-bench and docs; 25 minutes)"
	@echo "make lock       write requirements.lock anew (needs uv)"
	@echo "make clean      remove .venv, ./build, ./demo and ./site"

.venv/.locked: requirements.lock core/zig.lock
	@echo "Setting up .venv from requirements.lock ..."
	@$(PYTHON) -c 'import sys; sys.exit("pumafuse needs Python 3.11 or newer: make PYTHON=python3.12 ...") if sys.version_info < (3, 11) else None'
	$(PYTHON) -m venv .venv
	$(BIN)/python $(LOCKED) requirements.lock
	@$(BIN)/python core/backend.py || $(BIN)/python $(LOCKED) core/zig.lock
	@touch $@

$(READY): .venv/.locked pyproject.toml $(CORE)
	$(BIN)/python $(INPLACE)
	@touch $@

demo: $(READY)
	$(BIN)/pumafuse demo --output demo --force

# Tests of one file go to one worker, which sets up once what they share.
test: $(READY)
	$(BIN)/python -m pytest -m "not long" -n 2 --dist loadfile

# Tests of one group go to one worker: they share what takes long to set up, or listen on a port that a page names.
# Some wait more than they compute, so there is a worker more than cores.
test-long: $(READY)
	$(BIN)/python -m pytest -m long -n 3 --dist loadgroup

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

docs: $(READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --site-dir site
	@echo "open site/index.html; its search needs a server: python3 -m http.server --bind 127.0.0.1 --directory site"

notebooks: $(READY)
	$(BIN)/python notebooks/run.py

# Peers live apart: what they need may be older or newer than what pumafuse is locked to.
.venv-bench/.ready: requirements.lock pyproject.toml benchmarks/requirements-peers.txt $(CORE)
	$(PYTHON) -m venv .venv-bench
	.venv-bench/bin/python $(LOCKED) requirements.lock
	.venv-bench/bin/python -m pip install --quiet --disable-pip-version-check --no-compile --requirement benchmarks/requirements-peers.txt
	@.venv-bench/bin/python core/backend.py || .venv-bench/bin/python $(LOCKED) core/zig.lock
	.venv-bench/bin/python $(INPLACE)
	@touch $@

bench: .venv-bench/.ready
	.venv-bench/bin/python benchmarks/run.py --write
	.venv-bench/bin/python benchmarks/ros2.py --busy --seconds 60

# Universal: one lock for every platform and Python. No index address goes into it. ROS's bootstrapper would start every
# Python a second time, to set a path of libraries: the tests of ROS set it.
LOCK := uv pip compile --universal --generate-hashes --no-emit-index-url --no-header --quiet
EXTRAS := --extra bags --extra formats --extra ros2 --no-emit-package ros-wheels-bootstrapper
lock:
	$(LOCK) pyproject.toml $(EXTRAS) --group dev --output-file requirements.lock
	echo ziglang | $(LOCK) - --output-file core/zig.lock

clean:
	rm -rf .venv .venv-bench build demo site src/pumafuse/filter/_core.*
