# The whole workflow. Everything happens in .venv; the Rust parts are always built in release.
PYTHON ?= python3
BIN := .venv/bin
export PIP_CONSTRAINT := $(CURDIR)/constraints.txt
export PIP_DISABLE_PIP_VERSION_CHECK := 1

# What the tests use beside it: every optional part, so that none is skipped.
ALL_EXTRAS := dev,synthetic,video,bench,diffusion,segment,viewer,export,rerun,slurm,ray,browser

# Processes that share the tests; each works on one thread.
TEST_WORKERS ?= 2

# cpu takes torch's build without CUDA, a tenth of the download; default takes what pip finds.
TORCH ?= default
ifneq ($(filter-out cpu default,$(TORCH))$(words $(TORCH)),1)
$(error TORCH: expected cpu or default, found '$(TORCH)')
endif
TORCH_VERSION := $(shell sed -n 's/^torch==//p' constraints.txt)
TORCH_STAMP := $(if $(filter cpu,$(TORCH)),.venv/torch-cpu)

.PHONY: setup setup-all demo test lint test-rust test-python fuzz bench wheel clean

setup: $(BIN)/bigs

# Rebuilt when a Rust source, the packaging or a version changes; Python sources are used in place.
RUST_SOURCES := $(shell find rust -name '*.rs' -o -name Cargo.toml) Cargo.toml Cargo.lock
$(BIN)/bigs: pyproject.toml constraints.txt $(RUST_SOURCES) $(TORCH_STAMP)
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@$(BIN)/python -c "import torch" 2> /dev/null || echo "Downloading about 2.7 GB, torch with CUDA among it" \
	    "(5.4 GB on disk); make $(or $(MAKECMDGOALS),setup) TORCH=cpu needs about 0.5 GB (1.5 GB on disk)."
	$(BIN)/python -m pip install --quiet maturin
	. $(BIN)/activate && maturin develop --release --extras dev,synthetic,video
	@touch $(BIN)/bigs

# maturin keeps a torch that is there. uv knows where the builds without CUDA lie, pip only if it was told.
.venv/torch-cpu: constraints.txt
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@echo "Installing torch $(TORCH_VERSION) without CUDA (about 0.2 GB), then the rest (about 0.3 GB)."
	@$(BIN)/python -c "import sys, torch; sys.exit(torch.__version__ != '$(TORCH_VERSION)+cpu')" 2> /dev/null \
	  || $(BIN)/python -m pip install --quiet torch==$(TORCH_VERSION)+cpu 2> /dev/null \
	  || { $(BIN)/python -m pip install --quiet uv && $(BIN)/uv pip install --quiet --python $(BIN)/python \
	       --torch-backend=cpu --reinstall-package torch torch==$(TORCH_VERSION) 2> .venv/torch-cpu.log; } \
	  || { echo "TORCH=cpu: expected torch $(TORCH_VERSION) without CUDA, found none that pip or uv can reach" \
	       "(see .venv/torch-cpu.log): check the network, or install its wheel with $(BIN)/pip, and run the same" \
	       "command again" >&2; exit 1; }
	@touch $@

setup-all: .venv/all-extras
.venv/all-extras: $(BIN)/bigs
	. $(BIN)/activate && maturin develop --release --extras $(ALL_EXTRAS)
	@touch .venv/all-extras

demo: setup
	rm -rf demo_run
	$(BIN)/bigs demo --out demo_run

test: setup-all lint test-rust test-python

lint:
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy bigs
	cargo fmt --all --check
	cargo clippy --quiet --workspace --all-targets -- -D warnings

test-rust:
	cargo test --quiet -p bigs-raster -p bigs-raster-checks

test-python:
	$(BIN)/python -m pytest -n $(TEST_WORKERS) --dist worksteal

# Damaged files of every kind before the command line, for so many seconds.
FUZZ_SECONDS ?= 300
fuzz: setup
	$(BIN)/python -m tests.fuzzing --seconds $(FUZZ_SECONDS)

bench: setup
	cargo bench -p bigs-raster-checks

wheel: setup
	$(BIN)/maturin build --release --out dist

clean:
	rm -rf .venv target dist demo_run
