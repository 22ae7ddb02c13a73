# Two commands are all a newcomer needs: `make demo` and `make test`.
unexport PYTHONDONTWRITEBYTECODE  # processes start faster with compiled files
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
KANTOR := $(BIN)/kantor
PYTEST := $(BIN)/python -m pytest --dist loadgroup

.PHONY: help demo test test-fast check lint types contracts format paper bench bench-compare campaign mutants fuzz clean

help:
	@echo "make demo       set up, then five robot processes explore on the bus and leave a picture"
	@echo "make test       set up, then run all tests"
	@echo "make test-fast  set up, then run the unit tests with fewer drawn examples: at most a minute"
	@echo "make check      lint, types and import contracts"
	@echo "make format     format the code and fix what the linter can"
	@echo "make paper      the first paper's figures with a verdict beside each number (kantor reproduce all)"
	@echo "make bench      speed, as ratios in one run"
	@echo "make bench-compare REV=...  the same commands in two revisions in turn, and their ratios"
	@echo "make campaign   2000 drawn missions full of faults, with every checker"
	@echo "make mutants    planted bugs, and which checker catches each: docs/mutants.md"
	@echo "make fuzz       a million inputs for every decoder"

demo: $(VENV)/.installed
	$(KANTOR) run fleet --exchange realtime --speed 4

# Three workers for two cores: tests of processes wait for one another.
test: $(VENV)/.developing $(VENV)/.kernels
	$(PYTEST) -n 3

test-fast: $(VENV)/.developing $(VENV)/.kernels
	$(PYTEST) -n 2 -m unit --hypothesis-profile fast

check: lint types contracts

lint: $(VENV)/.developing
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

types: $(VENV)/.developing
	$(BIN)/mypy

contracts: $(VENV)/.developing
	$(BIN)/lint-imports

format: $(VENV)/.developing
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

paper: $(VENV)/.developing $(VENV)/.kernels
	$(KANTOR) reproduce all

bench: $(VENV)/.installed $(VENV)/.kernels
	$(BIN)/python benchmarks/run.py

bench-compare: $(VENV)/.installed
	$(BIN)/python benchmarks/compare.py $(REV)

campaign: $(VENV)/.installed $(VENV)/.kernels
	$(KANTOR) campaign

mutants: $(VENV)/.developing $(VENV)/.kernels
	$(BIN)/python tests/campaign/mutants.py

fuzz: $(VENV)/.developing $(VENV)/.kernels
	$(BIN)/python tests/fuzz/fuzz.py

$(VENV)/.installed: pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit("kantor needs Python 3.11 or newer" if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	@touch $@

# pip reads [dependency-groups] from version 25.1 on.
$(VENV)/.developing: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --upgrade 'pip>=25.1'
	$(BIN)/python -m pip install --quiet --group dev
	@touch $@

# Two processes compile what this machine does not have; an edited kernel is compiled when it is called.
$(VENV)/.kernels: | $(VENV)/.installed
	$(BIN)/python -c 'from kantor_fleet.execution.preload import warm_up; warm_up()'
	@touch $@

clean:
	rm -rf $(VENV) .mypy_cache .pytest_cache .ruff_cache .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
