# make demo, make test, make lint, make bench. Each makes .venv first if it is absent or stale.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SOAK := $(wildcard tests/test_kill.py tests/test_power_loss.py tests/test_disk_faults.py tests/test_bit_flips.py tests/test_store_model.py tests/test_edits.py)
STAMP := $(VENV)/stamp

.DEFAULT_GOAL := demo
.PHONY: demo test soak lint format bench venv clean

demo: $(STAMP)
	$(BIN)/terrasim run scenarios/jacksboro.toml --out out/jacksboro

test: $(STAMP)
	$(BIN)/python -m pytest $(PYTEST)

# The same tests at their full size: an hour or more.
soak: $(STAMP)
	TERRASIM_SOAK=1 $(BIN)/python -m pytest $(or $(PYTEST),$(SOAK))

lint: $(STAMP)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(STAMP)
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

bench: $(STAMP)
	$(BIN)/terrasim bench $(BENCH)

venv: $(STAMP)

# The stamp is written last, so an install that was cut short is begun again.
$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "terrasim needs Python 3.11 or newer, %s is %d.%d: make PYTHON=python3.12" % (sys.executable, *sys.version_info[:2]))'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

clean:
	rm -rf $(VENV) build dist out *.egg-info .mypy_cache .ruff_cache .pytest_cache .import_linter_cache
