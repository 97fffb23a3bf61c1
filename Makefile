# The whole workflow. Everything happens in .venv; the Rust parts are always built in release.
PYTHON ?= python3
BIN := .venv/bin
export PIP_CONSTRAINT := $(CURDIR)/constraints.txt
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: setup demo test lint test-rust test-python bench wheel clean

setup: $(BIN)/bigs

# Rebuilt when a Rust source, the packaging or a version changes; Python sources are used in place.
RUST_SOURCES := $(shell find rust -name '*.rs' -o -name Cargo.toml) Cargo.toml Cargo.lock
$(BIN)/bigs: pyproject.toml constraints.txt $(RUST_SOURCES)
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet maturin
	. $(BIN)/activate && maturin develop --release --extras dev,synthetic,video
	@touch $(BIN)/bigs

demo: setup
	rm -rf demo_run
	$(BIN)/bigs demo --out demo_run

test: setup lint test-rust test-python

lint:
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy bigs
	cargo fmt --all --check
	cargo clippy --quiet --workspace --all-targets -- -D warnings

test-rust:
	cargo test --quiet -p bigs-raster

test-python:
	$(BIN)/python -m pytest

bench: setup
	cargo bench -p bigs-raster

wheel: setup
	$(BIN)/maturin build --release --out dist

clean:
	rm -rf .venv target dist demo_run
