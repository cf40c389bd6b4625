# `make demo` on a fresh machine: environment, a rendered and fitted Cornell box, pictures in demo_output/.
# `make test`: environment, default tests. Both need Python >= 3.11 with the venv module, and pip's access to packages.

VENV ?= .venv
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
BIN := $(VENV)/bin
READY := $(VENV)/.installed

.PHONY: demo test test-slow lint doctor sweep environment clean help

help:
	@echo "make demo       render a scene, fit a parameter, write pictures to demo_output/"
	@echo "make test       default tests          make test-slow  the long ones"
	@echo "make lint       ruff and mypy          make doctor     check the machine"
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
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[cpu,vis,data,dev]'
	@touch $@

demo: $(READY)
	$(BIN)/torchtransient demo

doctor: $(READY)
	$(BIN)/torchtransient doctor

# As many processes as there are cores, up to four: most tests compute with one thread or wait for a compiler. A file
# stays in one of them. Compiled sources are kept: modules of plugins are executed anew at every change of the variant.
PARALLEL ?= -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder

test: $(READY)
	env -u PYTHONDONTWRITEBYTECODE $(BIN)/python -m pytest -q $(PARALLEL)

test-slow: $(READY)
	env -u PYTHONDONTWRITEBYTECODE $(BIN)/python -m pytest -q -m slow $(PARALLEL)

# Goes on where an earlier run has stopped: remove build/gradient_sweep.jsonl to begin anew.
sweep: $(READY)
	$(BIN)/python -m torchtransient.testing.gradient_sweep --write docs

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/mypy

clean:
	rm -rf build dist demo_output .pytest_cache .mypy_cache .ruff_cache
