# `make help` lists the targets. Every target prepares .venv first, and again when the requirements change.
# Options of `train` are variables with the option's name in capitals, passed on only when set:
#   make train METHOD=fmp RESET=dataset PRESET=laptop SEED=0 MINUTES=30 RUN=runs/walk

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:

VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
CONSTRAINTS := constraints.txt
UV := $(shell command -v uv 2>/dev/null)
install = $(if $(UV),uv pip install --quiet --python $(BIN)/python,$(BIN)/python -m pip install --quiet \
  --disable-pip-version-check) -c $(CONSTRAINTS) -e

comma := ,

# --name 'value' where the variable is set, nothing where it is not.
option = $(if $($(1)),--$(2) '$($(1))')
train_options = $(strip \
  $(call option,METHOD,method) $(call option,RESET,reset) $(call option,PRESET,preset) \
  $(call option,ROBOT,robot) $(call option,MOTION,motion) $(call option,FRAMES,frames) \
  $(call option,COMMAND,command) $(call option,SEED,seed) $(call option,SEEDS,seeds) $(call option,RUN,run) $(call option,MINUTES,minutes) \
  $(if $(filter-out 0 no false,$(RESUME)),--resume) $(ARGS))

# A variable that is given on the command line and read by none of the targets is a slip: training would go on without it.
known_train := METHOD RESET PRESET ROBOT MOTION COMMAND FRAMES SEED SEEDS RUN MINUTES RESUME ARGS
known_evaluate := RUN ARGS
known_render := RUN ARGS
known_test := WORKERS ARGS
known_test-fast := ARGS CONSTRAINTS
known_test-oldest := ARGS
known_coverage := ARGS
known_docs := ARGS
goals := $(or $(MAKECMDGOALS),$(.DEFAULT_GOAL))
known := $(foreach goal,$(goals),$(known_$(goal))) PYTHON UV VENV
given := $(foreach name,$(.VARIABLES),$(if $(filter command,$(firstword $(origin $(name)))),$(name)))
unknown := $(firstword $(filter-out $(known),$(given)))
ifneq ($(unknown),)
  close := $(shell for python in $(BIN)/python python3; do "$$python" -c 'import difflib, sys; \
    print(*difflib.get_close_matches(sys.argv[1].upper(), sys.argv[2:], 1))' '$(unknown)' $(known) 2>/dev/null && break; done)
  # What programs read from the environment belongs before `make`.
  hint := $(if $(filter JAX_% XLA_% CUDA_% MUJOCO_% FMPJAX_% PYTHON%,$(unknown)),; as an environment variable it stands before\
    make: $(unknown)=... make $(goals))
  $(error unknown variable $(unknown)$(if $(close),$(comma) perhaps $(close)): make $(goals) takes $(strip $(known))$(hint))
endif

.PHONY: train evaluate render test test-fast test-oldest coverage check docs format build clean help run-is-named

train: $(READY) ## train a policy: METHOD RESET PRESET ROBOT MOTION COMMAND FRAMES SEED SEEDS RUN MINUTES RESUME=1
	$(BIN)/fmpjax train $(train_options)

evaluate: run-is-named $(READY) ## evaluate a run: RUN=runs/walk
	$(BIN)/fmpjax evaluate '$(RUN)' $(ARGS)

render: run-is-named $(READY) ## render a run's policy as a video: RUN=runs/walk
	$(BIN)/fmpjax render '$(RUN)' $(ARGS)

# A file of tests at a time to each of two processes: most of the time is XLA's compiling, which uses one core.
# Warp runs on a CPU too: its tests need it, training does without its 150 MB. The same holds for ONNX Runtime, viser and
# the packages of the hub.
test: $(READY) $(VENV)/.extras ## run every test, in WORKERS processes (2)
	$(BIN)/python -m pytest -n $(or $(WORKERS),2) --dist loadfile --no-loadscope-reorder $(or $(ARGS),--ignore tests/alone)
	$(if $(ARGS),,$(BIN)/python -m pytest tests/alone)

test-fast: $(READY) ## run the tests that take seconds
	$(BIN)/python -m pytest -m 'not slow' $(ARGS)

test-oldest: ## run the tests that take seconds with the oldest versions that pyproject.toml allows, in .venv-oldest
	$(MAKE) test-fast VENV=.venv-oldest CONSTRAINTS=constraints-oldest.txt

check: $(READY) ## lint, and check the formatting, the arrows between modules and the types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-cache
	$(BIN)/ty check --no-progress --python $(VENV)

# Links are checked, a warning is an error, and nothing is fetched.
docs: $(READY) $(VENV)/.docs ## build the documentation site into site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet $(ARGS)

coverage: $(READY) ## the share of the lines that the fast tests run, file by file
	$(BIN)/python -m pytest -m 'not slow' --cov fmpjax --cov-report term:skip-covered $(ARGS)

format: $(READY) ## format, and fix what the linter can
	$(BIN)/ruff check --fix-only .
	$(BIN)/ruff format .

build: $(READY) ## build the source archive and the wheel into dist/
	$(BIN)/python -m build

clean: ## remove the environment, caches and builds; runs/ stays
	rm -rf $(VENV) .venv-oldest build dist site .coverage .hypothesis .import_linter_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

help: ## show this list
	@sed -nE 's/^([a-z-]+):[^#]*## (.*)/  \1\t\2/p' $(MAKEFILE_LIST) | expand -t 14

run-is-named:
	@$(if $(RUN),true,echo 'Name the run to read, for example: make $(firstword $(MAKECMDGOALS)) RUN=runs/walk' >&2; exit 2)

# Interpreters are tried by running them: a name on the path may be a shim with no Python of that version behind it.
$(READY): pyproject.toml $(CONSTRAINTS)
	@if [ ! -x $(BIN)/python ]; then \
	  if [ -n '$(UV)' ]; then uv venv --quiet --seed --python '$(or $(PYTHON),>=3.11$(comma)<3.14)' $(VENV); \
	  else \
	    for python in $(or $(PYTHON),python3 python3.13 python3.12 python3.11 python); do \
	      if "$$python" -c 'import ensurepip, sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' 2>/dev/null; \
	      then found="$$python"; break; fi; \
	    done; \
	    if [ -z "$${found:-}" ]; then \
	      echo 'fmpjax needs uv, or Python 3.11, 3.12 or 3.13 with its venv module, and found neither: install one, or name one with make PYTHON=/path/to/python.' >&2; \
	      exit 2; \
	    fi; \
	    "$$found" -m venv $(VENV); \
	  fi; \
	fi
	@$(install) '.[dev,viz,retarget]'
	@touch $@

$(VENV)/.extras: $(READY)
	@$(install) '.[warp,deploy,play,hub,benchmark]'
	@touch $@

$(VENV)/.docs: $(READY)
	@$(install) '.[docs]'
	@touch $@
