# make install   a virtual environment in .venv with everything at tested versions
# make demo      install, run 20 RiverGrid trials, draw the figures: minutes on two cores
# make test      install, run the tests, two at a time
# make lint      install, check style, types and spelling
# make docs      install, build the documentation into build/docs, with warnings as errors
# make chaos     install, kill whatever a sweep is made of for ten minutes: SECONDS=600 SEED=0
# make s3-test   install, run the tests of an object store against a server that speaks S3's protocol
# make storage-test   install, run a sweep on a cluster that shares an S3 server and no folder, and harm it: needs root, says so
# make cluster-test   install, run docker/compose.yaml's cluster in network namespaces and harm it: needs root, says so
#
# By default pip installs torch with CUDA, several GB that only a GPU needs. For CPUs only, at the first make:
#   make install TORCH_INDEX=https://download.pytorch.org/whl/cpu
PYTHON ?= python3
TORCH_INDEX ?=
BIN := .venv/bin

.PHONY: install demo test lint docs chaos cluster-test s3-test storage-test clean
.DEFAULT_GOAL := install

install: .venv/installed

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(None if sys.version_info >= (3, 11) else "recrl needs Python 3.11 or newer: make PYTHON=/path/to/python3.11")'
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt $(if $(TORCH_INDEX),--no-deps --index-url $(TORCH_INDEX)) torch
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

demo: install
	$(BIN)/recrl-sweep launch grids/demo.yaml

test: install
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder --max-worker-restart=0 --durations=20

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/codespell

docs: install
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[docs]'
	OMP_NUM_THREADS=1 $(BIN)/python -m sphinx -W --keep-going -d build/doctrees -b html docs build/docs

chaos: install
	$(BIN)/python tests/faults/chaos.py --seconds $(or $(SECONDS),600) --seed $(or $(SEED),0) --log results/chaos/seed-$(or $(SEED),0).txt

cluster-test: install
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt 'psycopg[binary]'
	$(BIN)/python -m tests.faults.cluster --log results/cluster/log.txt

# moto wants a newer graphql-core than MLflow: it stays beside the environment
s3-test: install
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt s3fs
	$(BIN)/pip install --quiet --disable-pip-version-check --target .venv/moto 'moto[server]==5.2.5'
	PYTHONPATH=.venv/moto $(BIN)/python -c 'import s3fs, moto.server'  # without them the tests are skipped
	PYTHONPATH=.venv/moto $(BIN)/python -m pytest -q tests/orchestrator/test_s3.py

storage-test: s3-test
	PYTHONPATH=.venv/moto $(BIN)/python -m tests.faults.cluster_storage --log results/cluster/storage.txt

clean:
	rm -rf .venv build dist src/*.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
