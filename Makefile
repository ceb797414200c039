# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
#
# Needs make and Python >= 3.10 with pip, nothing else. `make PYTHON=python3.12` takes that Python.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP_INSTALL := -m pip install -q --disable-pip-version-check
COMMA := ,

.PHONY: help demo test lint setup clean
.DEFAULT_GOAL := help

# A process of the ROS 2 wheels hands down two things: the sign that its libraries are on the path, with which the
# Python of our environment would not look for its own, and that path.
ifdef _ROS_WHEELS_BOOTSTRAP_COMPLETE
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE
export LD_LIBRARY_PATH := $(shell printf %s "$$LD_LIBRARY_PATH" | tr : '\n' | grep -v '/ros_[^/]*\.libs$$' | paste -s -d :)
endif

# The Python behind $(PYTHON), which may be the one of an environment that goes away; empty if it is too old.
BASE := $(shell $(PYTHON) -c 'import os, sys; print(os.path.realpath(sys.executable) if sys.version_info >= (3, 10) else "")' 2>/dev/null)
# A sourced ROS 2 is used instead of the wheels, with what its system has.
SOURCED := $(if $(ROS_DISTRO),$(shell $(BASE) -c 'import rclpy' 2>/dev/null && echo $(ROS_DISTRO)))
EXTRAS := dev$(if $(SOURCED),,$(COMMA)ros)

# The last step of a set-up notes what for; without that note, or with another, the environment is made anew.
STAMP := $(VENV)/g2_recon_set_up
KERNELS := $(VENV)/g2_recon_compiled
WANTED := $(CURDIR) with $(BASE)$(if $(SOURCED), and ROS 2 $(SOURCED))
FOUND := $(shell $(BIN)/python -c '' 2>/dev/null && cat $(STAMP) 2>/dev/null)
ifneq ($(WANTED),$(FOUND))
NEW := yes
.PHONY: $(STAMP)
endif

help:  ## list what there is to make
	@sed -n 's/^\([a-z]*\):.*  ## /\1\t/p' Makefile

demo: setup  ## the whole way on the bundled recording, to out/demo
	$(BIN)/g2-recon demo -o out/demo

test: setup lint  ## all checks and tests, ROS 2 included
	$(BIN)/python -m pytest

lint: setup  ## formatting, style and types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

setup: $(STAMP) kernels  ## the environment in .venv, with g2-recon and colcon in .venv/bin

# Numba keeps what it compiled beside a source and looks at that source only, not at the kernels that it imports from
# others: after any change all of them are compiled anew.
.PHONY: kernels
kernels: $(STAMP)
	@[ -z "$$(find g2_recon -name '*.py' -newer $(KERNELS) 2>/dev/null)" ] && [ -e $(KERNELS) ] || { \
		find g2_recon -name '*.nb[ic]' -delete && \
		echo "Compiling; this takes a minute or two" && $(BIN)/python -m g2_recon.warm_up && touch $(KERNELS); }

$(STAMP): Makefile package.xml pyproject.toml setup.cfg setup.py
	$(if $(BASE),,$(error g2_recon needs Python >= 3.10, but '$(PYTHON)' is $(or $(shell { $(PYTHON) -V; } 2>/dev/null),not there); name another one: make PYTHON=python3.12))
	@echo "Setting up $(VENV) for $(WANTED); this takes a minute or two"
	@$(if $(NEW),rm -rf $(VENV),rm -f $@)
	@$(if $(NEW),$(MAKE_VENV))
	@PYTHONWARNINGS=ignore $(BIN)/python $(PIP_INSTALL) -e '.[$(EXTRAS)]'
	@$(BIN)/python $(PIP_INSTALL) $(NUMPY_TYPES)
	@$(BIN)/python -c 'import rclpy' 2>/dev/null || echo "No ROS 2 sourced and no wheels of it for this machine: nodes and their tests are off"
	@$(BIN)/g2-recon --version
	@echo '$(WANTED)' > $@

# Debian and Ubuntu have a package of its own for what puts pip into an environment; without it, pip installs itself.
MAKE_VENV = $(BASE) -m venv $(VENV_OPTIONS) $(VENV) >/dev/null 2>&1 || { \
	$(BASE) -m venv --clear --without-pip $(VENV_OPTIONS) $(VENV) && \
	$(BASE) $(PIP_INSTALL) --target $(VENV)/pip pip && \
	PYTHONPATH=$(VENV)/pip $(BIN)/python $(PIP_INSTALL) --ignore-installed pip && \
	rm -rf $(VENV)/pip; }
VENV_OPTIONS := $(if $(SOURCED),--system-site-packages)

# NumPy's types change with its releases and Python 3.10 gets another release than 3.14: mypy checks against this one
# (setup.cfg), so that its verdict is the same everywhere.
NUMPY_TYPES := --target $(VENV)/types --upgrade --no-deps --ignore-requires-python --only-binary :all: \
	--python-version 3.10 --platform manylinux2014_x86_64 numpy==2.2.6

clean:  ## remove everything made here
	rm -rf $(VENV) out build install log .mypy_cache .pytest_cache .ruff_cache .hypothesis *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
