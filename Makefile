# Two commands do all the set-up: `make explore` and `make test`.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
OUT ?= runs
PIP_FLAGS ?=
PYTEST_FLAGS ?=
COVERAGE ?=
DOCS = $(BIN)/python -m sphinx --quiet --fail-on-warning --keep-going -c docs . -b

.PHONY: explore results test faults lint docs docs-links clean

$(VENV)/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check $(PIP_FLAGS) \
	  --editable ".[dev]"
	touch $@

# The main job: explore without a reward, perform four tasks, report.
explore: $(VENV)/.installed
	$(BIN)/python -m experiments.study --out $(OUT)

# The reports on the committed runs, from their logs, the cards of the models that come
# along, and the picture of the method.
results: $(VENV)/.installed
	$(BIN)/python -m experiments.run --phase report --out results/paper
	$(BIN)/python -m experiments.run --phase report --out results/paper-no-refit
	$(BIN)/python -m experiments.run --phase report --out results/laptop
	cp results/paper/report/table1.json results/table1.json
	$(BIN)/python -m experiments.report.method_figure results/method.svg
	$(BIN)/python -m experiments.tools.shipped

test: $(VENV)/.installed
	$(BIN)/python $(COVERAGE) -m pytest -n 2 --dist loadfile $(PYTEST_FLAGS)

# Hours: what is lost where anything fails while a run writes. See results/faults.md.
faults: $(VENV)/.installed
	PYTHONPATH=.:tests $(BIN)/python -m faults.bench $(FAULTS)

lint: $(VENV)/.installed
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright --pythonpath $(BIN)/python

$(VENV)/.documented: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check $(PIP_FLAGS) \
	  --editable ".[docs]"
	touch $@

# The site, in docs/_build/index.html; every warning is an error, and so is every link
# that leads nowhere. `make docs-links` asks the network about the others.
docs: $(VENV)/.documented
	$(DOCS) html docs/_build

docs-links: $(VENV)/.documented
	$(DOCS) linkcheck docs/_build/linkcheck

clean:
	rm -rf $(VENV) docs/_build
