# SPDX-License-Identifier: Apache-2.0
# Every target builds what it needs; `make setup` takes a moment when nothing has changed.
SHELL := /bin/bash
BIN := .venv/bin

.PHONY: setup demo test lint bench clean help
help:
	@echo "make setup | demo | test | lint | bench | clean"
setup:
	@tools/setup.sh
demo: setup
	@$(BIN)/python tools/demo.py
lint: setup
	@$(BIN)/ruff check .
test: lint
	@$(BIN)/python -m pytest -n 2 --dist worksteal
bench: setup
	@test -d build/rivals || $(BIN)/python -m pip install --quiet --disable-pip-version-check \
		--no-deps --target build/rivals -r tools/bench-requirements.txt \
		|| echo "bench: the rivals could not be installed and are left out"
	@PYTHONPATH=build/rivals $(BIN)/python test/bench/run.py
clean:
	rm -rf .venv build install log selfcal_ros.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
