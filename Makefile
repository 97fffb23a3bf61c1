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

.PHONY: setup setup-all demo test lint test-rust test-python fuzz bench wheel clean miri asan memcheck neon fuzz-engine

setup: $(BIN)/bigs

# Rebuilt when a Rust source, the packaging or a version changes; Python sources are used in place. They are compiled
# here, since many containers let Python write no bytecode, and every start would compile them anew.
RUST_SOURCES := $(shell find rust -name '*.rs' -o -name Cargo.toml) Cargo.toml Cargo.lock
$(BIN)/bigs: pyproject.toml constraints.txt $(RUST_SOURCES) $(TORCH_STAMP)
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@$(BIN)/python -c "import torch" 2> /dev/null || echo "Downloading about 2.7 GB, torch with CUDA among it" \
	    "(5.4 GB on disk); make $(or $(MAKECMDGOALS),setup) TORCH=cpu needs about 0.5 GB (1.5 GB on disk)."
	$(BIN)/python -m pip install --quiet maturin
	. $(BIN)/activate && maturin develop --release --extras dev,synthetic,video
	@$(BIN)/python -m compileall -q bigs
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
	cargo test --quiet -p bigs-raster -p bigs-ops -p bigs-shape -p bigs-track -p bigs-raster-checks

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

# Deeper checks of the engine. Each needs a tool that the rest does not, and says which where it is missing; their
# outcomes are in docs/stability.md.
RASTER := -p bigs-raster
HOST := $(shell rustc -vV 2>/dev/null | sed -n 's/^host: //p')
skip = { echo "make $@: skipped. It needs $(1)"; exit 0; }

# Undefined behaviour: the buffer pool, shared slices, sort, lists, vectors of the baseline, and one small image. The
# image by the rules of tree borrows, because rayon's queues break the older ones, and with its threads left running.
miri:
	@cargo +nightly miri --version > /dev/null 2>&1 || \
	$(call skip,Miri: rustup toolchain install nightly --component miri --component rust-src); \
	export MIRIFLAGS=-Zmiri-disable-isolation RAYON_NUM_THREADS=2; \
	cargo +nightly miri test $(RASTER) --lib -- memory:: lists:: simd:: math::real && \
	MIRIFLAGS="$$MIRIFLAGS -Zmiri-tree-borrows -Zmiri-ignore-leaks" cargo +nightly miri test $(RASTER) --test hostile -- colours_without_channels

# Memory errors of all kernels that this machine has. The unstable flag works on stable with RUSTC_BOOTSTRAP.
asan:
	@test "$(HOST)" = x86_64-unknown-linux-gnu || $(call skip,a 64-bit x86 Linux); \
	RUSTC_BOOTSTRAP=1 RUSTFLAGS=-Zsanitizer=address cargo test $(RASTER) --target $(HOST) --target-dir target/asan \
		--lib --test fuzz --test hostile --test oracle --test golden

# The same for the baseline by valgrind, which knows no AVX-512, and finds uninitialised memory too.
memcheck:
	@command -v valgrind > /dev/null || $(call skip,valgrind); \
	CARGO_TARGET_$(shell echo $(HOST) | tr a-z- A-Z_)_RUNNER="valgrind --quiet --error-exitcode=1" \
	BIGS_RASTER_SIMD=baseline cargo test $(RASTER) --test golden --test hostile -- --skip thousands

# The NEON kernels, built for ARM and run in an emulator.
neon:
	@rustup target list --installed 2> /dev/null | grep -q aarch64-unknown-linux-gnu || \
	$(call skip,the target: rustup target add aarch64-unknown-linux-gnu); \
	command -v aarch64-linux-gnu-gcc > /dev/null && command -v qemu-aarch64 > /dev/null || \
	$(call skip,the Debian packages qemu-user gcc-aarch64-linux-gnu libc6-dev-arm64-cross); \
	CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=aarch64-linux-gnu-gcc \
	CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_RUNNER="qemu-aarch64 -L /usr/aarch64-linux-gnu" \
	cargo test $(RASTER) --target aarch64-unknown-linux-gnu --lib --test hostile --test golden --test oracle -- \
		--skip every_cpu_level --skip peak

# Hostile calls of the engine that coverage looks for, under the address sanitizer; FUZZ_SECONDS=600 for longer. The
# first call builds for minutes. The unstable flags work on stable with RUSTC_BOOTSTRAP.
fuzz-engine:
	@cargo fuzz --version > /dev/null 2>&1 || $(call skip,cargo-fuzz: cargo install cargo-fuzz); \
	cd rust && RUSTC_BOOTSTRAP=1 cargo fuzz run --fuzz-dir fuzz calls -- \
		-max_total_time=$(FUZZ_SECONDS) -max_len=512 -timeout=30
