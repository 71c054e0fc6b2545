# SPDX-License-Identifier: Apache-2.0
.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help setup demo test test-fast test-unit test-ros lint typecheck colcon-smoke golden bench bench-peers lock clean

PYTHON_IN := .venv/bin/python
PYTEST := tools/with_test_env $(PYTHON_IN) -m pytest

help: ## list the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## (.*)/\1\t\2/' | expand -t 14

setup: ## make or refresh .venv: ROS 2 Jazzy, messages, trainid_ros, lab/ (PYTHON=... selects the interpreter)
	@PYTHON='$(PYTHON)' tools/setup

demo: setup ## play a bag through the three live nodes and write a report
	.venv/bin/trainid demo

test: lint typecheck colcon-smoke test-unit test-ros ## everything that must pass before a change lands

test-fast: setup ## inner loop: the unit tests alone
	$(PYTEST) -m 'not ros and not slow' -n 2 -q

test-unit: setup ## tests that need no ROS graph
	$(PYTEST) -m 'not ros' -n 2

test-ros: setup ## tests that start nodes
	$(PYTEST) -m ros

lint: setup ## style and common mistakes
	.venv/bin/ruff check .

typecheck: setup ## static types, strict
	.venv/bin/mypy

colcon-smoke: setup ## build the workspace with colcon, start an installed node, stop it
	tools/with_test_env $(PYTHON_IN) tools/colcon_smoke.py

golden: setup ## regenerate expected outputs and config/params.yaml; review the difference before committing it
	tools/with_test_env $(PYTHON_IN) test/golden/make_golden.py
	tools/with_test_env $(PYTHON_IN) -m trainid_ros.ros.params_template > config/params.yaml

bench: setup .venv-peers/stamp ## measure speed and accuracy, also of the papers and of other libraries
	$(PYTHON_IN) benchmarks/run.py

bench-peers: setup .venv-peers/stamp ## compare with other libraries on the same data
	$(PYTHON_IN) benchmarks/run.py --only peers

# A folder that only the benchmarks use, after .venv on the path, with the same versions.
.venv-peers/stamp: tools/requirements/peers.lock
	rm -rf .venv-peers
	$(PYTHON_IN) -m pip install --quiet --no-deps --require-hashes --no-build-isolation --target .venv-peers -r $<
	touch $@

lock: ## resolve the pinned requirements again (needs uv)
	python3 tools/lock.py

clean: ## remove the environment and everything generated
	rm -rf .venv .venv-peers build install log .mypy_cache .ruff_cache .pytest_cache .hypothesis trainid_ros.egg-info lab/trainid_lab.egg-info lab/build
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
