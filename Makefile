# Two commands do everything on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
# What the tests need besides; the demo does without.
TEST_READY := $(VENV)/.ready-tests
TEST_EXTRAS ?= test,lint,postgres,serve,browser,nuscenes
# "no" goes on where the libraries of open3d are missing; only `simulate` and `demo` need them.
SIMULATION ?= yes

.PHONY: venv venv-tests demo test shapes prove prove-gpu prove-bare fuzz fuzz-all bench lint docs site wheel \
	clean

venv: $(READY)

venv-tests: $(TEST_READY)

demo: $(READY)
	$(BIN)/curate demo

test: $(TEST_READY)
	$(BIN)/python -m pytest -n 2 --dist worksteal

# The same tests, with the shape of every array checked wherever a function of curate is called.
shapes: $(TEST_READY)
	$(BIN)/python -m pytest -n 2 --dist worksteal \
		--jaxtyping-packages=curate,support.shapes.check

prove: $(TEST_READY)
	$(BIN)/python -m pytest -m slow

# Checks on a GPU, with frames per second; without one it says that they were not run.
prove-gpu: $(READY)
	$(BIN)/python .ci/prove_gpu.py

# Installation, demo and a part of the tests in minimal systems that debootstrap makes; as root.
SUITES ?= bookworm trixie
prove-bare:
	$(PYTHON) .ci/prove_bare.py $(SUITES)

wheel: $(TEST_READY)
	$(BIN)/pip wheel -q --no-deps --no-build-isolation --wheel-dir dist .

# `make test` tries the same damaged files every time; this tries new ones, for an hour in all, and
# prints a log. The files of its findings are in .fuzzing/.
FUZZ_SECONDS ?= 3600
fuzz-all: $(TEST_READY)
	cd tests && PYTHONPATH=.:.. ../$(BIN)/python -m fuzzing.all_readers $(FUZZ_SECONDS) ../.fuzzing

# Coverage-guided, where atheris is installed: make fuzz READER="label file" SECONDS=600
READER ?= labels
SECONDS ?= 60
fuzz: $(TEST_READY)
	cd tests && PYTHONPATH=.:.. ../$(BIN)/python -m fuzzing.guided "$(READER)" $(SECONDS)

# One thread per library; ratios and frames per second, written to docs/benchmarks.{json,md}.
bench: $(TEST_READY)
	$(BIN)/pip install -q -c constraints.txt -e '.[bench]'
	@mkdir -p .benchmarks
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest tests/benchmarks/bench_*.py -q \
		-o python_functions='bench_*' --benchmark-disable-gc --benchmark-group-by=group \
		--benchmark-columns=min,median,rounds --benchmark-json=.benchmarks/measured.json
	$(BIN)/python tests/benchmarks/report.py .benchmarks/measured.json docs

lint: $(TEST_READY)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy curate db pipelines curate_command.py

docs: $(TEST_READY)
	$(BIN)/python -m docs.generate

# The pages as a website in site/, which loads nothing from elsewhere.
site: $(READY)
	$(BIN)/pip install -q -c constraints.txt -e '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

clean:
	rm -rf $(VENV) demo site

# The CPU build of torch is taken where the index offers one and no GPU is in sight; the constraint
# accepts either build of the same version.
$(READY): pyproject.toml constraints.txt
	@$(PYTHON) .ci/check_system.py $(if $(filter no,$(SIMULATION)),--without-simulation)
	@echo "Creating $(VENV)/: about 2.2 GB, one to five minutes, mostly for downloads."
	@$(PYTHON) -m venv $(VENV)
	@command -v nvidia-smi >/dev/null 2>&1 \
		|| { echo "1 of 2: PyTorch, the build without CUDA"; \
		$(BIN)/python .ci/install.py 900 torch==2.13.0+cpu --otherwise \
			"The index does not offer it; the general build follows, which may be larger."; }
	@echo "2 of 2: curate and the packages that it needs"
	@$(BIN)/python .ci/install.py 1350 .
ifneq ($(SIMULATION),no)
	@$(BIN)/python -c 'from curate.simulation.open3d_loader import load; load()'
endif
	@touch $@

$(TEST_READY): $(READY)
	@echo "Adding the packages of the tests to $(VENV)/: about 0.8 GB"
	@$(BIN)/python .ci/install.py 800 '.[$(TEST_EXTRAS)]'
	@touch $@
