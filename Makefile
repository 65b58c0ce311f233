# Every target does its own set-up: the first command on a fresh clone may be any of them.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed
LOWEST := .venv-lowest
INSTALL = $(BIN)/uv pip install --quiet --system-certs --python $(BIN)/python --constraint constraints.txt
# A part of the tests that touches every dependency.
QUICK  := tests/laws/test_interfaces.py tests/core/test_bad_input.py tests/envs/test_environment_api.py \
	tests/evaluation/test_evaluation.py tests/policies/test_model_files.py \
	tests/training/test_resume.py::test_a_resumed_training_is_the_uninterrupted_one \
	tests/journeys/test_newcomer.py tests/journeys/test_field_study.py

.PHONY: help demo test test-all test-lowest mutants mutants-sample coverage wheel-test wheel films benchmark papers papers-check zoo pages docs integrations \
	integrations-tianshou integrations-rejax integrations-rllib lines lint format bench clean

help:  ## list the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 23

# torch comes first and at its pinned version: left to a range, an installer may take a build
# with several GB of GPU libraries.
$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed: make PYTHON=python3.12 ...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --no-compile --constraint constraints.txt torch uv
	$(INSTALL) --editable '.[agents,test]'
	touch $@

demo: $(STAMP)  ## train two agents and compare them with rules under the same budget: runs/demo/
	$(BIN)/fusion-gym demo

test: $(STAMP)  ## the tests, without the slow ones
	$(BIN)/python -m pytest -m "not slow" -n 2

test-all: $(STAMP)  ## all tests
	$(BIN)/python -m pytest -n 2

# uv reads the lower bounds of pyproject.toml. torch keeps its pinned version: its oldest wheels bring
# GPU libraries.
$(LOWEST)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv --clear $(LOWEST)
	$(LOWEST)/bin/python -m pip install --disable-pip-version-check --quiet --no-compile --constraint constraints.txt torch uv
	grep '^torch==' constraints.txt > $(LOWEST)/torch.txt
	$(LOWEST)/bin/uv pip install --quiet --system-certs --python $(LOWEST)/bin/python \
		--resolution lowest-direct --overrides $(LOWEST)/torch.txt \
		--requirements pyproject.toml --extra agents --extra test
	touch $@

mutants: $(STAMP)  ## tests that must fail, each on a known wrong variant of the code
	$(BIN)/python tests/mutants/apply.py

mutants-sample: $(STAMP)  ## the share of killed mutants in 18 modules, 300 drawn by a seed
	$(INSTALL) mutmut
	mkdir -p runs
	$(BIN)/python tests/mutants/sample.py --output runs/mutants.json --resume

test-lowest: $(LOWEST)/.installed  ## quick tests with the lowest versions that pyproject.toml allows
	$(LOWEST)/bin/python -m pytest -m "not slow" -n 2 $(QUICK)

wheel-test: $(STAMP)  ## the package outside the repository, and every command of README and docs with it
	OMP_NUM_THREADS=1 PYTHONPATH=tests/helpers $(BIN)/python tests/repository/wheel_smoke.py

wheel: $(STAMP)  ## build the wheel into dist/
	$(BIN)/python -m build --wheel

coverage: $(STAMP)  ## what the journeys reach: files by share, functions in runs/coverage/function_index.html
	rm -rf runs/coverage && mkdir -p runs/coverage
	cd runs/coverage && export PATH="$(CURDIR)/$(BIN):$$PATH" && for journey in $(CURDIR)/tests/journeys/scripts/*.py; do \
		coverage run --append --source=$(CURDIR)/fusion_gym,$(CURDIR)/agents $$journey || exit; done && \
		coverage report --sort=cover && coverage html --directory=.

# One episode of every environment under its paper's rule, for the pages.
WATCH := $(BIN)/fusion-gym watch --steps 40 --fps 6 --env fusion_gym
films: $(STAMP)  ## the films of docs/films
	$(BIN)/fusion-gym watch --env fusion_gym/TobitOscillator-v1 --fps 6 --policy zoo:tobit_oscillator_scheduler,price=0.2 \
		--against dynamic_event --save docs/films/tobit_oscillator.gif --set horizon=60 filter=tobit random_start=true \
		token_rate=2.0 memory=true cost_weight=0.2
	$(WATCH)/GymnasiumEnvironment-v1 --policy send_on_delta:threshold=0.5 --save docs/films/any_environment.gif \
		--set 'env_kwargs={"render_mode": "rgb_array"}'
	$(WATCH)/BiasedOscillator-v2 --policy round_robin --save docs/films/biased_oscillator.gif
	$(WATCH)/BiasedTracking-v1 --policy round_robin --save docs/films/biased_tracking.gif
	$(WATCH)/CorrelatedTracking-v1 --policy adaptive_innovation --save docs/films/correlated_tracking.gif
	$(WATCH)/MarkovJumpTracking-v1 --policy local_variance:m=0.9 --save docs/films/markov_jump.gif
	$(WATCH)/UnknownInput-v1 --policy adaptive_threshold --save docs/films/unknown_input.gif
	$(WATCH)/RemoteEstimation-v1 --policy whittle --save docs/films/remote_estimation.gif
	$(WATCH)/LinearFusion-v2 --policy value_of_information --save docs/films/linear_fusion.gif

# Libraries beside this one: each folder of integrations/ has pins and a virtual environment of its own,
# .venv-light, .venv-tianshou, .venv-rejax, .venv-rllib.
.venv-%/.installed: integrations/%/requirements.txt integrations/%/constraints.txt pyproject.toml
	$(PYTHON) -m venv --clear .venv-$*
	.venv-$*/bin/python -m pip install --disable-pip-version-check --quiet --no-compile \
		--constraint integrations/$*/constraints.txt \
		$$(grep '^torch==' integrations/$*/requirements.txt) $$(grep '^uv==' constraints.txt)
	.venv-$*/bin/uv pip install --quiet --system-certs --python .venv-$*/bin/python \
		--constraint integrations/$*/constraints.txt --overrides integrations/$*/left_out.txt \
		--requirements integrations/$*/requirements.txt
	.venv-$*/bin/uv pip install --quiet --system-certs --python .venv-$*/bin/python --no-deps --editable .
	touch $@

integrations: .venv-light/.installed  ## other libraries: SB3, rl-zoo3, TorchRL, SuperSuit, MO-Gymnasium, Minari
	.venv-light/bin/python -m pytest integrations/light

integrations-tianshou: .venv-tianshou/.installed  ## Tianshou
	.venv-tianshou/bin/python -m pytest integrations/tianshou

integrations-rejax: .venv-rejax/.installed  ## rejax
	.venv-rejax/bin/python -m pytest integrations/rejax

integrations-rllib: .venv-rllib/.installed  ## RLlib
	.venv-rllib/bin/python -m pytest integrations/rllib

benchmark: $(STAMP)  ## triggers, rules and learned policies of every class, 150 minutes: results/
	$(BIN)/python -m agents.benchmark

papers: $(STAMP)  ## the five papers' tables, curves and claims: docs/reproduction/
	$(BIN)/python -m agents.papers all --resume

papers-check: $(STAMP)  ## the papers' verdicts from a tenth of the episodes, against the pages'
	$(BIN)/python -m agents.papers all --check --work runs/papers-check

zoo: $(STAMP)  ## the best learned policies of the benchmark: fusion_gym/zoo/
	$(BIN)/python -m agents.zoo

lines:  ## code lines without blanks, comments and docstrings, and words of prose
	@$(PYTHON) tests/repository/lines.py
	@$(PYTHON) tests/repository/prose.py

lint: $(STAMP)  ## ruff and mypy
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(STAMP)  ## let ruff fix what it can
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Beside the other packages, for the tutorials train agents. Warnings end it. The outputs of the pages' Python stay in runs/docs/.
$(VENV)/.docs: $(STAMP)
	$(INSTALL) --editable '.[agents,docs]'
	touch $@

pages: $(STAMP)  ## tables in docs/, from the code
	$(BIN)/python -m docs.tables

docs: $(VENV)/.docs  ## the documentation site into site/, its Python executed, links checked
	$(BIN)/python -m docs.tables --check
	OMP_NUM_THREADS=1 $(BIN)/python -m sphinx -W --keep-going -q -j 2 -c docs -d runs/docs/doctrees . site/html
	echo '<meta http-equiv="refresh" content="0; url=html/docs/index.html">' > site/index.html

bench: $(STAMP)  ## steps per second beside the alternatives, as ratios of one run
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.throughput

clean:  ## remove the virtual environment and caches (not runs/)
	rm -rf $(VENV) $(LOWEST) .venv-light .venv-tianshou .venv-rejax .venv-rllib site build .pytest_cache .mypy_cache .ruff_cache .hypothesis *.egg-info
