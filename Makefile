# Every target does its own set-up: the first command on a fresh clone may be any of them.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed
LOWEST := .venv-lowest
# A part of the tests that touches every dependency.
QUICK  := tests/conformance/test_faces.py tests/test_bad_input.py tests/test_environment_api.py \
	tests/test_evaluation.py tests/test_model_files.py \
	tests/test_agents.py::test_training_writes_its_results_and_resumes \
	tests/test_benchmark.py::test_from_tuning_to_report_and_zoo

.PHONY: help demo test test-all test-lowest wheel-test wheel lint format bench clean

help:  ## list the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 13

# torch comes first and at its pinned version: left to a range, an installer may take a build
# with several GB of GPU libraries.
$(STAMP): pyproject.toml setup.py constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed: make PYTHON=python3.12 ...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --constraint constraints.txt --editable '.[agents,test]'
	touch $@

demo: $(STAMP)  ## train two fronts, compare them with the strongest rules, draw the figures
	$(BIN)/python -m agents.demo

test: $(STAMP)  ## the tests, without the slow ones
	$(BIN)/python -m pytest -m "not slow" -n 2

test-all: $(STAMP)  ## all tests
	$(BIN)/python -m pytest -n 2

# uv reads the lower bounds of pyproject.toml. torch keeps its pinned version: its oldest wheels bring
# GPU libraries.
$(LOWEST)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv --clear $(LOWEST)
	$(LOWEST)/bin/python -m pip install --disable-pip-version-check --quiet --constraint constraints.txt torch uv
	grep '^torch==' constraints.txt > $(LOWEST)/torch.txt
	$(LOWEST)/bin/uv pip install --quiet --system-certs --python $(LOWEST)/bin/python \
		--resolution lowest-direct --overrides $(LOWEST)/torch.txt \
		--requirements pyproject.toml --extra agents --extra test
	touch $@

test-lowest: $(LOWEST)/.installed  ## quick tests with the lowest versions that pyproject.toml allows
	$(LOWEST)/bin/python -m pytest -m "not slow" -n 2 $(QUICK)

wheel-test: $(STAMP)  ## build the package and try it in an empty folder, outside the repository
	$(BIN)/python tests/wheel_smoke.py

wheel: $(STAMP)  ## build the wheel into dist/
	$(BIN)/python -m build --wheel

lint: $(STAMP)  ## ruff and mypy
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(STAMP)  ## let ruff mend what it can
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(STAMP)  ## steps per second beside the alternatives, as ratios of one run
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.throughput

clean:  ## remove the virtual environment and caches (not runs/)
	rm -rf $(VENV) $(LOWEST) build .pytest_cache .mypy_cache .ruff_cache .hypothesis *.egg-info
