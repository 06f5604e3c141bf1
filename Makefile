# Every command builds .venv first, once, and again when pyproject.toml or the plugin's source changes.

PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/installed
# Files go out in their order, not the longest lists of tests first: clusters have few tests, which take minutes.
SPREAD := -n auto --maxprocesses=4 --dist=loadfile --no-loadscope-reorder
# In processes of their own: the soak measures the memory of its process, in which no other test may have left holes; tests of
# Ray's jobs enter a network namespace, and threads of libraries that begin there would stay there for later tests.
SOAK := tests/faults/test_soak.py
RAY_JOBS := tests/clusters/test_ray_jobs.py
ROOMS := storage workers learner service

export OMP_NUM_THREADS = 1
export OPENBLAS_NUM_THREADS = 1
export MKL_NUM_THREADS = 1

.PHONY: install train test test-fast view check bench bench-libraries fuzz soak clean

install: $(STAMP)

$(STAMP): pyproject.toml $(wildcard */native/*.[ch] */*/native/*.[ch] */*/*/native/*.[ch])
	test -d $(VENV) || $(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check --editable '.[dev]'
	touch $(STAMP)

train: install
	$(BIN)/t6gps train flat-quick

# All tests, some 25 minutes on two cores; then those that need neither Ray nor a trained run, four and a half.
test: install
	$(BIN)/pytest $(SPREAD) --ignore=$(SOAK) --ignore=$(RAY_JOBS)
	$(BIN)/pytest $(SOAK)
	$(BIN)/pytest $(RAY_JOBS)

test-fast: install
	$(BIN)/pytest $(SPREAD) -m "not slow and not ray"

# The tree as `t6gps/...`, in links, for tools that do not know how the rooms are mapped into the package.
view:
	@mkdir -p build/typing/t6gps && for room in $(ROOMS) deploy; do ln -sfn ../../../$$room build/typing/t6gps/$$room; done
	@for file in __init__.py __main__.py py.typed; do ln -sfn ../../../deploy/t6gps/$$file build/typing/t6gps/$$file; done

check: install view
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	cd build/typing && PYTHONPATH=. ../../$(BIN)/lint-imports --config ../../pyproject.toml
	cd build/typing && MYPYPATH=. ../../$(BIN)/mypy --config-file ../../pyproject.toml --namespace-packages \
		--explicit-package-bases t6gps/__init__.py t6gps/__main__.py $(ROOMS:%=t6gps/%)

bench: install
	$(BIN)/t6gps bench physics

# The service beside Gymnasium's AsyncVectorEnv and RLlib, in the same rounds; ten minutes, JSON on stdout.
bench-libraries: install
	@$(BIN)/python tests/libraries/compare.py

# Two thousand mutated files of each kind of ground, a minute: each gives heights or one error, in bounded time and memory.
fuzz: install
	$(BIN)/python tests/workers/ground/fuzz.py 2000

# A hundred requests for each route of the server, within what its own document allows and as many beyond it.
.PHONY: api
api: install
	T6GPS_API_EXAMPLES=100 $(BIN)/pytest tests/service/server/test_document.py

# Twenty kills, a learner that pauses for a minute, and half an hour of workers killed, stopped and scaled at random;
# the figures are printed at the end.
soak: install
	T6GPS_SOAK_MINUTES=30 $(BIN)/pytest -s tests/faults/test_workers.py tests/faults/test_soak.py -k 't1_ or t13 or t14'

# The image: built with buildah, then one iteration trained in it. IMAGE_ARGS goes to `buildah build`.
BASE ?= docker.io/library/python:3.11-slim-bookworm
IMAGE ?= t6gps
.PHONY: image
image:
	buildah build --build-arg BASE=$(BASE) $(IMAGE_ARGS) --file deploy/Dockerfile --tag $(IMAGE) .
	bash tests/clusters/image.sh $(IMAGE)

# Tables of measured figures in README.md and docs, from docs/figures.
.PHONY: docs
docs: install
	$(BIN)/python docs/render.py

clean:
	rm -rf build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
