# SPDX-License-Identifier: Apache-2.0
#
# What a person can do here.  Needs make, git and python3; `make setup` gets the
# rest.  The long steps are scripts, so that they can be run and read alone.

SHELL  := /bin/bash
PYTHON ?= python3
VENV   := .venv/bin
# `make test T=tcp` runs the tests whose names match; T may be any pytest -k expression.
T      ?=
# `make test JUNIT=build/junit.xml` writes the results for a machine, too.
JUNIT  ?=
# Rounds of each program in `make test-programs`.
ROUNDS ?= 200
# More arguments for pytest, e.g. PYTEST_ARGS=-x.
PYTEST_ARGS ?=
# `make test TESTS=tests/unit` takes one kind only.
TESTS  ?= $(wildcard tests/unit tests/native tests/platform tests/integration)

# `make test-kernels KERNELS=trixie KERNEL_TESTS=tests/native/test_engine_kills.py`
KERNELS ?= jammy bookworm noble trixie backports
KERNEL_TESTS ?= tests/native
# What `make test-machine` runs on Debian 13.
MACHINE_TESTS ?= demo $(addprefix tests/integration/test_,hooks_podman.py quadlet.py run.py trees_scripts.py packages.py upgrade.py)

# `make test-aarch64 AARCH64_TESTS=tests/native/test_engine_eintr.py CPU_MODEL=max`
AARCH64_TESTS ?= tests/native

# `make test-sqlite KILLS=20`, `make soak SECONDS=600`: shorter.
KILLS   ?= 200
SECONDS ?= 3600

export PYTHON

help: ## this list
	@printf 'avckpt keeps Podman containers alive through crashes.\n\n'
	@sed -n 's/^\([a-z][a-z0-9-]*\):.*## \(.*\)/make \1|\2/p' $(MAKEFILE_LIST) | \
		while IFS='|' read -r name what; do printf "  %-20s %s\n" "$$name" "$$what"; done

setup: setup-build setup-images ## install and build everything that demo and test need

setup-build: ## the part of setup that makes .venv and compiles (no Podman needed)
	@scripts/setup-system.sh
	@scripts/setup-venv.sh

setup-images: ## the part of setup that makes Podman work and builds the images
	@scripts/setup-base.sh
	@scripts/setup-podman.sh
	@scripts/setup-sidecar.sh

setup-tests: # what tests need beyond setup
	@scripts/setup-system.sh view
	@scripts/setup-trees.sh
	@scripts/setup-docker.sh

demo: setup ## kill a protected container's application twice and watch it go on
	@$(VENV)/python -m scripts.demo

test: setup setup-tests ## every test (T=expression selects, TESTS=folder narrows)
	@$(VENV)/python -m pytest $(TESTS) $(PYTEST_ARGS) $(if $(T),-k "$(T)") $(if $(JUNIT),--junit-xml="$(JUNIT)")

.PHONY: build-aarch64
build-aarch64: setup-build ## cross-compile everything for aarch64, below build/aarch64
	@scripts/setup-system.sh aarch64
	@scripts/build-aarch64.sh

deb: setup-build ## a Debian package for this Debian: command line, hooks, init, guard, sidecar as a service (build/*.deb)
	@scripts/make-deb.sh

deb-image: setup ## another, for a sidecar that is a container: its image (build/*.deb)
	@scripts/make-deb-image.sh

wheel: setup-build ## a wheel for pipx or pip, with everything `avckpt install --sidecar` needs (build/wheel)
	@rm -rf build/wheel && $(VENV)/python -m pip wheel --disable-pip-version-check -q --no-deps --no-build-isolation -w build/wheel . && ls build/wheel

test-packages: setup ## install the wheel and the .deb, build the sidecar's image from the wheel
	@AVCKPT_LONG=1 $(VENV)/python -m pytest tests/integration/test_packages.py --timeout 900 $(PYTEST_ARGS)

sweep: setup-build ## kill the guard before each of its system calls and stores, one run each: nobody notices (three hours)
	@AVCKPT_SWEEP=all $(VENV)/python -m pytest tests/native/test_engine_sweep.py $(PYTEST_ARGS) $(if $(T),-k "$(T)")

test-programs: setup ## checkpoint, kill and restore real programs, ROUNDS times each, in both modes of avckpt.tcp
	@scripts/setup-programs.sh
	@$(VENV)/python -m bench.programs --rounds $(ROUNDS)

test-trees: setup ## the tests of process trees at length: more kills, 200 processes, PostgreSQL under load
	@scripts/setup-trees.sh
	@AVCKPT_LONG=1 $(VENV)/python -m pytest tests/native/test_engine_trees.py $(wildcard tests/integration/test_trees_*.py) \
		--timeout 3000 $(PYTEST_ARGS) $(if $(T),-k "$(T)")

test-kernels: ## the engine's tests on other kernels, in emulated machines (KERNELS="jammy bookworm noble trixie backports"; an hour each)
	@scripts/setup-machine.sh $(KERNELS)
	@for kernel in $(KERNELS); do scripts/test-machine.sh $$kernel $(KERNEL_TESTS) $(PYTEST_ARGS) $(if $(T),-k "$(T)") || exit; done

test-machine: setup ## demo, hooks, Quadlet, trees, packages on Debian 13 (Podman 5.4, systemd, cgroup v2), in an emulated machine
	@AVCKPT_MACHINE=trixie scripts/setup-machine.sh trixie
	@CPUS=$${CPUS:-1} AVCKPT_MACHINE=trixie scripts/test-machine.sh trixie $(MACHINE_TESTS) $(PYTEST_ARGS) $(if $(T),-k "$(T)")

test-aarch64: build-aarch64 ## the engine's tests on Debian 12 for aarch64, in an emulated machine (CPU_MODEL=max: with SVE, MTE)
	@CPU_MODEL=$(CPU_MODEL) scripts/test-aarch64.sh $(AARCH64_TESTS) $(PYTEST_ARGS) $(if $(T),-k "$(T)")

# All that tests run and would compile themselves, before several runs of pytest do it at once.
build-tests: setup-build
	@$(MAKE) -s -j2 -C native
	@$(MAKE) -s -j2 -C native SANITIZE=1
	@$(MAKE) -s -j2 -C native STEPS=1
	@$(MAKE) -s -j2 -C tests/victims
	@$(MAKE) -s -C tests/victims STATIC=1 build-static/intruder
	@$(MAKE) -s -C tests/fuzz SEEDS=1

lint: setup-build ## ruff, mypy --strict, layers of the engine, shellcheck, clang-format; a missing tool is a failure
	@scripts/setup-system.sh lint
	@scripts/lint.sh

test-sqlite: setup ## kill SQLite under write load in containers, strict and rewind (KILLS=200; about an hour)
	@$(VENV)/python -m bench.sqlite --kills $(KILLS)

fuzz: setup-build ## fuzz what reads what containers, hooks and files say: SECONDS=20 for each target (T="proc api": these)
	@scripts/setup-fuzz.sh
	@$(VENV)/python -m tests.fuzz --seconds $(if $(filter file,$(origin SECONDS)),20,$(SECONDS)) $(T)

soak: setup-build ## an hour of checkpoints, deaths and restores: does anything leak? (SECONDS=3600)
	@$(VENV)/python -c 'import matplotlib' 2>/dev/null || $(VENV)/python -m pip install --disable-pip-version-check -q 'matplotlib>=3.6'
	@$(VENV)/python -m bench.soak --seconds $(SECONDS)

bench: setup ## measure freeze, reap and restore beside a plain fork()
	@$(VENV)/python -m bench.run
	@$(VENV)/python -m bench.dirty

bench-peers: setup ## measure avckpt beside CRIU (bare, and through Podman), cold start and a plain fork()
	@scripts/setup-plots.sh
	@scripts/setup-peers.sh
	@scripts/setup-ros.sh
	@$(VENV)/python -m bench.peers
	@$(VENV)/python -m bench.ros_peers

bench-cost: setup-build ## measure what checkpoints cost a request/reply server over time
	@scripts/setup-plots.sh
	@$(VENV)/python -m bench.cost

bench-ros: setup ## crash nodes of a ROS pipeline, beside cold start: latency, recovery, messages cut in half, costs
	@scripts/setup-ros.sh
	@$(VENV)/python -m bench.ros

bench-ros-long: setup ## the same pipeline: 1,000 crashes, one every one or two seconds (half an hour)
	@scripts/setup-ros.sh
	@$(VENV)/python -m bench.ros_endurance

bench-ros2: setup ## measure CycloneDDS and zenoh over restores: outages against the age of the checkpoint
	@scripts/setup-ros2.sh
	@$(VENV)/python -m bench.ros2

bench-cri: setup ## a pod of two containers through containerd's CRI socket: KILLS=500 crashes
	@scripts/setup-docker.sh
	@$(VENV)/python -c 'import grpc_tools' 2>/dev/null || $(VENV)/python -m pip install --disable-pip-version-check -q 'grpcio-tools>=1.50'
	@$(VENV)/python -m bench.cri --kills $(if $(filter file,$(origin KILLS)),500,$(KILLS))

bench-trees: setup-build ## measure freeze and restore of process trees beside forks, copies and unprotected commands
	@$(VENV)/python -m bench.trees

campaign: setup ## inject faults into protected containers in C++, Python, Go and ROS: what becomes of them (RUNS=50 WINDOW=60; hours)
	@scripts/setup-campaign.sh
	@scripts/setup-ros.sh
	@$(VENV)/python -m bench.campaign --runs $(or $(RUNS),50) --seconds $(or $(WINDOW),60) --parallel 40 --go-on --label avckpt.interval=1s
	@$(VENV)/python -m bench.campaign_show

clean: ## remove what was built here (images and the base's cache stay)
	rm -rf build .venv native/build native/build-san native/build-fuzz native/build-steps tests/fuzz/build tests/fuzz/build-seeds .pytest_cache .mypy_cache .ruff_cache
	rm -rf tests/victims/build sidecar/avckpt/_native.c sidecar/avckpt/_native*.so *.egg-info
	find hooks sidecar native tests testkit scripts examples bench -name __pycache__ -type d -prune -exec rm -rf {} + 2>/dev/null; true

clean-system: clean ## also remove images, cached base and what setup-podman.sh changed
	scripts/setup-podman.sh --undo
	scripts/clean-images.sh

.PHONY: help deb deb-image wheel test-packages setup setup-build setup-images setup-tests demo test sweep test-programs test-trees test-kernels test-machine test-aarch64 build-tests test-sqlite soak fuzz lint bench bench-peers bench-cost bench-ros bench-ros-long bench-ros2 bench-cri bench-trees campaign clean clean-system
.DEFAULT_GOAL := help
