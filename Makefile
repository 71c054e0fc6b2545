# SPDX-License-Identifier: Apache-2.0
.DEFAULT_GOAL := help
.PHONY: help setup demo test tests test-fast test-unit test-long test-ros lint typecheck colcon-smoke wheel wheels golden docs bench research research-test research-peers lock clean

PYTHON_IN := .venv/bin/python
PYTEST := tools/with_test_env $(PYTHON_IN) -m pytest
# A file stays in one process, and files with few and long tests do not come last.
BY_FILE := --dist loadfile --no-loadscope-reorder

help: ## list the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## (.*)/\1\t\2/' | expand -t 14

setup: ## make or refresh .venv: ROS 2 Jazzy, messages, trainid_ros, research/lab (PYTHON=... selects the interpreter)
	@PYTHON='$(PYTHON)' tools/setup

demo: ## play bags through the three live nodes and V-MILS, write a report; what else there is to set up follows beside it
	@PYTHON='$(PYTHON)' tools/setup --sources
	@nice tools/setup >.venv/setup_beside_demo.log 2>&1 & .venv/bin/trainid demo; code=$$?; wait; exit $$code

test: lint ## everything that must pass before a change lands
	@# The tests first: they take longest, and where they wait the checks beside them use the processor.
	$(MAKE) --no-print-directory --jobs 2 --output-sync=none tests typecheck wheel colcon-smoke

tests: setup ## all tests but the long ones and those of the benchmarks
	$(PYTEST) -m 'not long' --ignore test/benchmarks -n 3 $(BY_FILE)

test-fast: setup ## inner loop: the unit tests of the package alone
	$(PYTEST) -m 'not ros and not slow and not long' --ignore test/benchmarks -n 2 -q

test-unit: setup ## all tests that need no ROS graph
	$(PYTEST) -m 'not ros and not long' -n 2 $(BY_FILE)

test-long: setup ## tests of the benchmarks and on fresh seeds by the dozen, minutes long, and colcon with the messages
	tools/with_test_env $(PYTHON_IN) tools/colcon_smoke.py --all
	$(PYTEST) -m 'not long' test/benchmarks -n 2 $(BY_FILE)
	$(PYTEST) -m long -n 2

research-test: setup ## tests of research/: the algorithms and experiments of the four papers
	$(PYTEST) research/test -n 2

test-ros: setup ## tests that start nodes
	$(PYTEST) -m ros -n 2 $(BY_FILE)

lint: setup ## style and common mistakes
	.venv/bin/ruff check .

typecheck: setup ## static types, strict
	.venv/bin/mypy

colcon-smoke: setup ## build the package with colcon, start an installed node, stop it (make test-long: messages too)
	tools/with_test_env $(PYTHON_IN) tools/colcon_smoke.py

wheel: setup ## build a wheel with compiled modules in out/wheels and try it in a clean environment
	tools/with_test_env $(PYTHON_IN) tools/wheel_smoke.py --out out/wheels

wheels: setup ## the same for each Python 3.11 and 3.12 of this machine
	tools/with_test_env $(PYTHON_IN) tools/wheel_smoke.py --out out/wheels --all

golden: setup ## regenerate expected outputs, config/params.yaml and pictures of the monitor; review the difference before committing it
	PYTHONPATH=. tools/with_test_env $(PYTHON_IN) test/golden/make_golden.py
	tools/with_test_env $(PYTHON_IN) -m trainid_ros.setup.params_file > config/params.yaml
	tools/with_test_env $(PYTHON_IN) -m tools.monitor_picture

docs: setup .venv-docs/stamp ## build the documentation site in out/site; a broken link is an error
	PYTHONPATH=.venv-docs NO_MKDOCS_2_WARNING=1 $(PYTHON_IN) -m mkdocs build --strict

bench: setup .venv-peers/stamp ## measure speed and accuracy, also of the papers and of other libraries
	$(PYTHON_IN) benchmarks/run.py

research: setup ## repeat the experiments of the four papers (SEEDS=2 for a quick look)
	$(PYTHON_IN) benchmarks/run.py --only liu2018 yuan2017 xia2023 zheng2015 --seeds $(or $(SEEDS),60)

research-peers: setup .venv-peers/stamp ## compare with other libraries on the same data
	$(PYTHON_IN) benchmarks/run.py --only peers

# Folders that only the benchmarks and only the site use, beside .venv, with the same versions.
.venv-%/stamp: tools/requirements/%.lock
	rm -rf $(@D)
	$(PYTHON_IN) -m pip install --quiet --no-deps --require-hashes --no-build-isolation --target $(@D) -r $<
	touch $@

lock: ## resolve the pinned requirements again (needs uv)
	python3 tools/lock.py

clean: ## remove the environment and everything generated
	rm -rf .venv .venv-peers .venv-docs build install log .mypy_cache .ruff_cache .pytest_cache .hypothesis
	rm -rf trainid_ros.egg-info research/lab/trainid_lab.egg-info research/lab/build
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
