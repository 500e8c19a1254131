# Two commands on a fresh machine: `make demo` and `make test`. Both make .venv first.
PYTHON ?= python3
PY := .venv/bin/python
RUN ?= runs/flume
# One thread a process: several one-thread processes beat threads here (docs/accuracy.md).
export OMP_NUM_THREADS ?= 1

.PHONY: demo test lint benchmarks clean

.venv: .venv/.done
.venv/.done: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(PY) -m pip install --quiet --upgrade pip
	$(PY) -m pip install --quiet --constraint constraints.txt --editable ".[dev]"
	touch $@

demo: .venv/.done
	.venv/bin/gns-design optimize examples/flume.toml --budget 24 --verify 3 --out $(RUN)

# A process a core; each takes from the others' tests when its own are done.
JOBS ?= auto
test: .venv/.done
	$(PY) -m pytest --numprocesses $(JOBS) --dist worksteal --durations=15

lint: .venv/.done
	.venv/bin/ruff check .
	.venv/bin/mypy gns_model gns_env design

benchmarks: .venv/.done
	$(PY) benchmarks/mpm.py
	$(PY) benchmarks/mpm_torch.py
	$(PY) benchmarks/upstream_depth.py
	$(PY) benchmarks/vector_env.py

clean:
	rm -rf .venv runs build *.egg-info
