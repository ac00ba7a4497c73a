# Two commands do all the set-up: `make explore` and `make test`.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
OUT ?= runs
PIP_FLAGS ?=
PYTEST_FLAGS ?=
COVERAGE ?=

.PHONY: explore results test faults lint clean

$(VENV)/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check $(PIP_FLAGS) \
	  --editable ".[dev]"
	touch $@

# The main job: explore without a reward, perform four tasks, report.
explore: $(VENV)/.installed
	$(BIN)/python -m experiments.run --phase explore --out $(OUT)
	$(BIN)/python -m experiments.run --phase zero-shot --out $(OUT) --video $(OUT)/cheetah.mp4
	$(BIN)/python -m experiments.run --phase report --out $(OUT)

# The reports on the committed runs, from their logs, and the picture of the method.
results: $(VENV)/.installed
	$(BIN)/python -m experiments.run --phase report --out results/paper
	$(BIN)/python -m experiments.run --phase report --out results/paper-no-refit
	$(BIN)/python -m experiments.run --phase report --out results/laptop
	cp results/paper/report/table1.json results/table1.json
	$(BIN)/python -m experiments.report.method_figure results/method.svg

test: $(VENV)/.installed
	$(BIN)/python $(COVERAGE) -m pytest -n 2 --dist loadfile $(PYTEST_FLAGS)

# Hours: what is lost where anything fails while a run writes. See results/faults.md.
faults: $(VENV)/.installed
	PYTHONPATH=.:tests $(BIN)/python -m faults.bench $(FAULTS)

lint: $(VENV)/.installed
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright --pythonpath $(BIN)/python

clean:
	rm -rf $(VENV)
