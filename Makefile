# SPDX-License-Identifier: Apache-2.0
# Every target builds what it needs; `make setup` takes a moment when nothing has changed.
SHELL := /bin/bash
BIN := .venv/bin

QUICK := test/shipped/test_bags.py test/shipped/test_configs.py test/cli/test_mistakes.py test/cli/test_front.py \
	test/cli/test_arguments.py test/cli/test_solve.py test/cli/test_apply.py test/nodes/sessions test/reporting/test_html.py \
	test/test_house.py test/test_portable.py

.PHONY: help setup demo quick test tests test-313 test-oldest lint ament-lint mistakes bench soak chaos power-cuts mutants reality \
	pictures docs map3d reference sbom clean
help:  ## this list
	@awk -F ':.*  ## ' '/^[a-z0-9-]+:.*  ## / {printf "make %-12s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
setup:  ## the environment .venv, without ROS installed
	@tools/setup.sh
demo: setup  ## replay a recorded bag through the live nodes, and show the map
	@$(BIN)/python tools/demo.py
lint: setup  ## style, types
	@$(BIN)/ruff format --quiet --check .
	@$(BIN)/ruff check .
	@$(BIN)/mypy --num-workers $(shell nproc)
build/linters/.complete: tools/linter-requirements.txt | setup
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --upgrade \
		--target build/linters -r $< && touch $@ || echo "ament-lint: left out: its linters cannot be installed"
LINTED := selfcal_ros launch tools examples setup.py test
build/linters/.clean: build/linters/.complete setup.cfg $(shell find $(LINTED) -name '*.py')
	@test ! -e $< || { PYTHONPATH=build/linters $(BIN)/python -m flake8 --config setup.cfg $(LINTED) \
		&& touch $@ && echo "ament-lint: nothing found"; }
ament-lint: build/linters/.clean  ## what ament_flake8 and ament_pep257 check
# bytecode is kept: else each worker compiles all tests anew, and each process that they start the package
# three workers on two cores: as a rule one waits for a message
build/oracles/.complete: tools/oracle-requirements.txt tools/printer-requirements.txt tools/plate-requirements.txt | setup
	@mkdir -p build/oracles; for pins in $^; do $(BIN)/python -m pip install --quiet --disable-pip-version-check \
		--no-deps --require-hashes --upgrade --target build/oracles -r $$pins \
		|| echo "test: what $$pins names is left out: it cannot be installed"; done; touch $@
build/machines/.complete: tools/machine-requirements.txt | setup
	@mkdir -p build/machines; $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --require-hashes \
		--upgrade --target build/machines -r $< && touch $@ || echo "test: pymmcore and pyserial are left out: they cannot be installed"
build/oracles/dcc/dcc.xsd: tools/dcc_schema.py | setup
	@$(BIN)/python $< $(@D) || true
test: lint ament-lint tests  ## everything: linters and all tests, a quarter of an hour and more
tests: build/oracles/.complete build/oracles/dcc/dcc.xsd build/machines/.complete  ## all tests, without the linters
	@PYTHONDONTWRITEBYTECODE= PYTHONPATH="$(CURDIR)/build/oracles:$(CURDIR)/build/machines$${PYTHONPATH:+:$$PYTHONPATH}" $(BIN)/python -m pytest -n 3 --dist worksteal
quick: setup  ## two minutes: the tests that reach most of the code
	@$(BIN)/python -m pytest -q -n 2 -m "not ros" $(QUICK)
test-313:  ## the quick tests with Python 3.13, where it is there
	@for python in python3.13 $$HOME/.pyenv/versions/3.13.*/bin/python none; do $$python -c '' 2>/dev/null && break; done; \
		test $$python != none || { echo "test-313: left out: no Python 3.13"; exit 0; }; \
		VENV=.venv-313 PYTHON=$$python tools/setup.sh && .venv-313/bin/python -m pytest -q -n 2 -m "not ros" $(QUICK)
mistakes: setup  ## what newcomers type wrong, and whether one line helps
	@$(BIN)/python tools/mistakes.py
test-oldest:  ## with the libraries of Ubuntu 24.04, e.g. make test-oldest TESTS=test/applications/laser
	@pkg-config --exists freetype2 && test -e /usr/include/libqhull_r/qhull_ra.h || { \
		echo "test-oldest: apt install pkg-config libfreetype-dev libqhull-dev" >&2; exit 2; }
	@VENV=.venv-oldest PINS=tools/oldest.txt SOURCES=matplotlib MPLSETUPCFG="$$PWD/tools/matplotlib.cfg" \
		tools/setup.sh
	@.venv-oldest/bin/python -m pytest -n 3 --dist worksteal $(TESTS)
bench: setup  ## speed and memory, beside other programs
	@test build/rivals/.complete -nt tools/bench-requirements.txt || { mkdir -p build/rivals; \
		grep -v '^#' tools/bench-requirements.txt | while read -r rival; do \
		$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --upgrade \
		--target build/rivals "$$rival" || echo "bench: $$rival is left out: no such wheel here"; \
		done; touch build/rivals/.complete; }
	@PYTHONPATH=build/rivals $(BIN)/python test/bench/run.py
soak: setup  ## a long live run, e.g. make soak HOURS=8 SIZE=21
	@$(BIN)/python tools/soak.py --hours $(or $(HOURS),1) --size $(or $(SIZE),21)
chaos: setup  ## nodes killed and messages lost at random, minutes, e.g. make chaos ROUNDS=3 SEED=7
	@$(BIN)/python tools/chaos.py $(if $(ROUNDS),--rounds $(ROUNDS)) $(if $(SEED),--seed $(SEED))
power-cuts: setup  ## a measurement killed at 20 points and resumed, minutes, e.g. make power-cuts CUTS=6 SEED=2
	@$(BIN)/python tools/power_cuts.py $(if $(CUTS),--cuts $(CUTS)) $(if $(SEED),--seed $(SEED))
mutants: setup  ## do the tests notice a flipped sign?, e.g. make mutants MUTANTS="--number 200 --only selfcal_ros/estimation"
	@$(BIN)/python -m tools.mutants $(MUTANTS)
reality: setup  ## coverage of U on machines unlike the model, minutes, e.g. make reality REALITY="--runs 10 --only drift"
	@$(BIN)/python -m tools.reality $(REALITY)
pictures: setup  ## the pictures of README and docs
	@$(BIN)/python tools/pictures.py
docs: setup  ## the documentation as a site, build/site
	@test -e build/mkdocs/.complete || { $(BIN)/python -m pip install --quiet --disable-pip-version-check \
		--upgrade --target build/mkdocs mkdocs-material==9.6.14 "mkdocs<2" && touch build/mkdocs/.complete; }
	@PYTHONPATH=build/mkdocs $(BIN)/python -m mkdocs build --strict
map3d:  ## the script of the turning map in reports; needs npm
	@cd tools/map3d && npm ci --silent && npm run --silent build
reference: setup  ## docs/reference/reference.md and config/params/all.yaml from the code
	@$(BIN)/python tools/reference.py
sbom: setup  ## sbom.json: pins, hashes, licences
	@$(BIN)/python tools/sbom.py
clean:  ## remove all that was built
	rm -rf .venv .venv-313 .venv-oldest build install log selfcal_ros.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
