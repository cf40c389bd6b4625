# `make demo` on a fresh machine: environment, a rendered and fitted Cornell box, a page and pictures in demo_output/.
# `make test`: environment, default tests. Both need Python >= 3.11 with the venv module, and pip's access to packages.

VENV ?= .venv
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
BIN := $(VENV)/bin
READY := $(VENV)/.installed

.PHONY: demo test test-portable test-slow test-browser soak test-lowest release-check audit lint doctor docs sweep mutants environment clean help

help:
	@echo "make demo       render a scene, fit a parameter, write a page and pictures to demo_output/"
	@echo "make test       default tests          make test-slow  the long ones"
	@echo "make test-portable  sensors, losses and reconstruction with the arithmetic of an older processor"
	@echo "make test-browser  pages in Chromium (Debian: apt-get install -y chromium)"
	@echo "make soak       sweeps (ten thousand mutated files for each reader, a thousand kills), longest cases (up to 4 h)"
	@echo "make lint       ruff and mypy          make doctor     check the machine"
	@echo "make test-lowest  smoke tests with the lowest versions that are allowed, in an environment of its own (6 GB)"
	@echo "make release-check  wheel and sdist, in dist/, and the wheel in an empty environment"
	@echo "make audit      known vulnerabilities of what is installed (asks the server of PyPI)"
	@echo "make docs       the documentation as a site, in build/site/html"
	@echo "make mutants ROOM= SEED=  sixty changes of a room's sources, and whether its tests notice; see docs/reliability.md"
	@echo "make sweep      every parameter of every plugin against finite differences; writes docs/gradients_sweep.md"

environment: $(READY)

$(READY): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { \
		echo "Python 3.11 or newer with the venv module is needed and was not found." >&2; \
		echo "Install it (Debian, Ubuntu: apt install python3 python3-venv) or say which: make $(MAKECMDGOALS) PYTHON=/path/to/python3" >&2; \
		exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[cpu,vis,view,data,dev,docs]'
	@touch $@

demo: $(READY)
	$(BIN)/torchtransient demo

doctor: $(READY)
	$(BIN)/torchtransient doctor

# Pages, reference and gallery as a site. Warnings are errors.
docs: $(READY)
	$(BIN)/python docs/site/build.py

# As many processes as there are cores, up to four: most tests compute with one thread or wait for a compiler. A file
# stays in one of them. Compiled sources are kept: modules of plugins are executed anew at every change of the variant.
# A process that dies is not replaced: pytest-xdist (3.8) would wait for its tests for ever.
PARALLEL ?= -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder --max-worker-restart 0

test: $(READY)
	env -u PYTHONDONTWRITEBYTECODE $(BIN)/python -m pytest -q $(PARALLEL)

# Rounding as on an older processor: the kernels of torch and MKL that every x86-64 has. Nothing may rest on its digits.
test-portable: $(READY)
	env -u PYTHONDONTWRITEBYTECODE ATEN_CPU_CAPABILITY=default MKL_CBWR=COMPATIBLE \
		$(BIN)/python -m pytest -q $(PARALLEL) tests/sensing tests/losses tests/reconstruction

test-slow: $(READY)
	env -u PYTHONDONTWRITEBYTECODE $(BIN)/python -m pytest -q -m slow $(PARALLEL)

# One process: pages are timed by a browser that takes several cores.
test-browser: $(READY)
	env -u PYTHONDONTWRITEBYTECODE $(BIN)/python -m pytest -q -m browser

# Each sweep in processes of its own; -s shows what was found.
soak: $(READY)
	env -u PYTHONDONTWRITEBYTECODE $(BIN)/python -m pytest -q -m soak -s

# PyPI's build of torch 2.6 for Linux brings CUDA. The one for the CPU alone is on a server of its own:
# make test-lowest TORCH_FROM="--index-url https://download.pytorch.org/whl/cpu"
TORCH_FROM ?=
LOWEST ?= build/lowest
SMOKE_TESTS := tests/test_axes.py tests/test_scalar_state.py tests/test_public_names.py tests/cli/test_commands.py \
	tests/cli/test_doctor.py tests/files tests/geometry tests/parametrize/test_poses.py \
	tests/parametrize/test_state.py tests/vis/test_scans.py tests/data/storage \
	tests/data/augmentation/test_image_types.py tests/training/test_checkpoint.py \
	tests/reconstruction/test_hidden_volume.py tests/sensing/test_devices.py

test-lowest:
	test -x $(LOWEST)/bin/python || $(PYTHON) -m venv $(LOWEST)
	$(LOWEST)/bin/python -m pip install --quiet --constraint constraints-lowest.txt $(TORCH_FROM) torch
	$(LOWEST)/bin/python -m pip install --quiet --constraint constraints-lowest.txt --editable '.[cpu,dev,deepinv]'
	cd $(LOWEST) && bin/torchtransient doctor
	OMP_NUM_THREADS=1 $(LOWEST)/bin/python -m pytest -q $(SMOKE_TESTS)

# The second environment has nothing but the wheel and what it asks for; the smoke test runs outside of the checkout.
# The wheel of LLVM ends its installation at the first start of Python, with a warning of its own: the doctor is before.
release-check:
	rm -rf dist build/release
	$(PYTHON) -m venv build/release/builder
	build/release/builder/bin/python -m pip install --quiet 'build>=1.2.2,!=1.5.1' 'twine>=6.1'
	build/release/builder/bin/python -m build --outdir dist .
	build/release/builder/bin/python -m twine check --strict dist/*
	$(PYTHON) -m venv build/release/empty
	build/release/empty/bin/python -m pip install --quiet --constraint constraints.txt torch
	build/release/empty/bin/python -m pip install --quiet --constraint constraints.txt "$$(ls dist/*.whl)[cpu]"
	cd build/release/empty && unset PYTHONPATH && bin/torchtransient doctor \
		&& bin/python -W error -c 'import torchtransient' \
		&& bin/python -W error $(CURDIR)/tests/release/smoke.py

# In an environment of its own: what pip-audit brings is not to be audited. It asks the server of PyPI.
audit: $(READY)
	test -x build/auditor/bin/pip-audit || $(PYTHON) -m venv build/auditor
	build/auditor/bin/python -m pip install --quiet 'pip-audit>=2.7'
	build/auditor/bin/pip-audit --skip-editable --path "$$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')"

# Goes on where an earlier run has stopped: remove build/gradient_sweep.jsonl to begin anew. One plugin alone, with the
# page's rows of the others: make sweep ONLY=retroreflector
sweep: $(READY)
	$(BIN)/python -m tools.gradient_sweep --write docs $(if $(ONLY),--only '$(ONLY)')
	$(if $(ONLY),,$(BIN)/python benchmarks/boundary_cost.py sweep --page docs/moving_shapes.md)

# ROOM: a name in tools/mutants/rooms.py. A run that was stopped goes on; its record is build/mutants/ROOM-SEED.jsonl.
mutants: $(READY)
	cd tools && OMP_NUM_THREADS=1 $(abspath $(BIN))/python -m mutants $(ROOM) $(SEED)

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/mypy

clean:
	rm -rf build dist demo_output .pytest_cache .mypy_cache .ruff_cache
