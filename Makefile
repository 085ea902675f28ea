# SPDX-License-Identifier: Apache-2.0
# Every target builds what it needs; `make setup` takes a moment when nothing has changed.
SHELL := /bin/bash
BIN := .venv/bin

.PHONY: setup demo test test-oldest lint ament-lint bench soak chaos mutants reality pictures map3d reference sbom clean help
help:
	@echo "make setup | demo | test | test-oldest | lint | ament-lint | bench | soak | chaos | mutants | reality | pictures | reference | sbom | clean"
setup:
	@tools/setup.sh
demo: setup
	@$(BIN)/python tools/demo.py
lint: setup
	@$(BIN)/ruff check .
	@$(BIN)/mypy
build/linters/.complete: tools/linter-requirements.txt | setup
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --upgrade \
		--target build/linters -r $< && touch $@ || echo "ament-lint: left out: its linters cannot be installed"
LINTED := selfcal_ros launch tools examples setup.py test
build/linters/.clean: build/linters/.complete setup.cfg $(shell find $(LINTED) -name '*.py')
	@test ! -e $< || { PYTHONPATH=build/linters $(BIN)/python -m flake8 --config setup.cfg $(LINTED) \
		&& touch $@ && echo "ament-lint: nothing found"; }
ament-lint: build/linters/.clean  # what ament_flake8 and ament_pep257 check, with setup.cfg
# bytecode is kept: else each worker compiles all tests anew, and each process that they start the package
# three workers on two cores: as a rule one waits for a message
build/oracles/.complete: tools/oracle-requirements.txt tools/printer-requirements.txt | setup
	@mkdir -p build/oracles; for pins in $^; do $(BIN)/python -m pip install --quiet --disable-pip-version-check \
		--no-deps --require-hashes --upgrade --target build/oracles -r $$pins \
		|| echo "test: what $$pins names is left out: it cannot be installed"; done; touch $@
build/machines/.complete: tools/machine-requirements.txt | setup
	@mkdir -p build/machines; $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --require-hashes \
		--upgrade --target build/machines -r $< && touch $@ || echo "test: pymmcore and pyserial are left out: they cannot be installed"
build/oracles/dcc/dcc.xsd: tools/dcc_schema.py | setup
	@$(BIN)/python $< $(@D) || true
test: lint ament-lint build/oracles/.complete build/oracles/dcc/dcc.xsd build/machines/.complete
	@PYTHONDONTWRITEBYTECODE= PYTHONPATH="$(CURDIR)/build/oracles:$(CURDIR)/build/machines$${PYTHONPATH:+:$$PYTHONPATH}" $(BIN)/python -m pytest -n 3 --dist worksteal
test-oldest:  # with the libraries of Ubuntu 24.04; e.g. make test-oldest TESTS=test/laser
	@pkg-config --exists freetype2 && test -e /usr/include/libqhull_r/qhull_ra.h || { \
		echo "test-oldest: apt install pkg-config libfreetype-dev libqhull-dev" >&2; exit 2; }
	@VENV=.venv-oldest PINS=tools/oldest.txt SOURCES=matplotlib MPLSETUPCFG="$$PWD/tools/matplotlib.cfg" \
		tools/setup.sh
	@.venv-oldest/bin/python -m pytest -n 3 --dist worksteal $(TESTS)
bench: setup
	@test build/rivals/.complete -nt tools/bench-requirements.txt || { mkdir -p build/rivals; \
		grep -v '^#' tools/bench-requirements.txt | while read -r rival; do \
		$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --upgrade \
		--target build/rivals "$$rival" || echo "bench: $$rival is left out: no such wheel here"; \
		done; touch build/rivals/.complete; }
	@PYTHONPATH=build/rivals $(BIN)/python test/bench/run.py
soak: setup  # e.g. make soak HOURS=8 SIZE=21
	@$(BIN)/python tools/soak.py --hours $(or $(HOURS),1) --size $(or $(SIZE),21)
chaos: setup  # minutes; e.g. make chaos ROUNDS=3 SEED=7
	@$(BIN)/python tools/chaos.py $(if $(ROUNDS),--rounds $(ROUNDS)) $(if $(SEED),--seed $(SEED))
mutants: setup  # e.g. make mutants MUTANTS="--number 200 --only selfcal_ros/estimation"
	@$(BIN)/python -m tools.mutants $(MUTANTS)
reality: setup  # minutes; e.g. make reality REALITY="--runs 10 --only drift"
	@$(BIN)/python -m tools.reality $(REALITY)
pictures: setup  # those of README and docs
	@$(BIN)/python tools/pictures.py
map3d:  # selfcal_ros/reporting/assets/map3d.min.js; needs npm
	@cd tools/map3d && npm ci --silent && npm run --silent build
reference: setup  # docs/reference.md
	@$(BIN)/python tools/reference.py
sbom: setup  # sbom.json: pins, hashes, licences
	@$(BIN)/python tools/sbom.py
clean:
	rm -rf .venv .venv-oldest build install log selfcal_ros.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
