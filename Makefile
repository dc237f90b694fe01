# `make demo` and `make test` work in a bare clone: they make the virtual environment themselves.
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed
TOOLS  := $(VENV)/.tools
TRAP   := ../$(BIN)/trap-motion
# setuptools warns of editable installs, which are meant here
PIP    := PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --disable-pip-version-check

# the tests' matrices are small, and several processes run at once
export OMP_NUM_THREADS ?= 1

.PHONY: demo test slow fuzz lint docs setup bench clean

setup: $(STAMP)
$(STAMP): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(PIP) --upgrade pip
	$(PIP) -e .
	@touch $@

# what only tests, checks and documentation need: a first result shouldn't wait for it
$(TOOLS): $(STAMP)
	$(PIP) -e '.[test,lint,docs]'
	@touch $@

# the paper's example: a stack with its true motion, both methods, errors and figures
demo: $(STAMP)
	@rm -rf demo && mkdir demo
	cd demo && $(TRAP) simulate
	cd demo && $(TRAP) estimate sim.tif --attenuation --method paper -o paper.h5
	cd demo && $(TRAP) compare paper.h5 truth.h5
	cd demo && $(TRAP) plot paper.h5 --truth truth.h5 --stack sim.tif
	cd demo && $(TRAP) estimate sim.tif --attenuation -o auto.h5
	cd demo && $(TRAP) compare auto.h5 truth.h5
	cd demo && $(TRAP) plot auto.h5 --truth truth.h5 --stack sim.tif
	@echo "Done: look at demo/paper.png and demo/auto.png."

test: $(TOOLS)
	$(BIN)/python -m pytest -m "not slow" -n 2

slow: $(TOOLS)
	$(BIN)/python -m pytest -m slow -n 2

# damaged files until VARIANTS of each kind are tried; a failure is repeated with the SEED that is printed
VARIANTS ?= 2000
SEED ?= $(shell date +%s)
fuzz: $(TOOLS)
	@echo "SEED=$(SEED)"
	FUZZ_SEED=$(SEED) FUZZ_VARIANTS=$(VARIANTS) $(BIN)/python -m pytest tests/faults/test_byte_flips.py tests/faults/test_configuration.py
	$(BIN)/python -m pytest tests/result/test_result_file.py -m slow -k flipped

lint: $(TOOLS)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# the pages of docs/ as a site: open site/index.html
docs: $(TOOLS)
	$(BIN)/mkdocs build --strict --quiet

# docs/benchmarks-paper.md, and docs/benchmarks-speed.md at a size that takes a few minutes
bench: $(STAMP)
	$(BIN)/python benchmarks/paper_table.py
	$(BIN)/python benchmarks/speed/run.py --quick

clean:
	rm -rf demo site $(VENV) build *.egg-info
