# The whole workflow. Everything happens in .venv; the Rust parts are always built in release.
PYTHON ?= python3
BIN := .venv/bin
export PIP_CONSTRAINT := $(CURDIR)/constraints.txt
export PIP_DISABLE_PIP_VERSION_CHECK := 1

# What the tests use beside it: every optional part, so that none is skipped.
ALL_EXTRAS := dev,synthetic,video,bench,diffusion,segment,viewer,export,rerun,slurm,ray,browser

# Processes that share the tests; each works on one thread.
TEST_WORKERS ?= 2

.PHONY: setup setup-all demo test lint test-rust test-python fuzz bench wheel clean

setup: $(BIN)/bigs

# Rebuilt when a Rust source, the packaging or a version changes; Python sources are used in place.
RUST_SOURCES := $(shell find rust -name '*.rs' -o -name Cargo.toml) Cargo.toml Cargo.lock
$(BIN)/bigs: pyproject.toml constraints.txt $(RUST_SOURCES)
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet maturin
	. $(BIN)/activate && maturin develop --release --extras dev,synthetic,video
	@touch $(BIN)/bigs

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
