# `make demo` and `make test` are all a fresh machine needs; each prepares what it uses (scripts/setup).

PY = .venv/bin/python
# Some containers set it. Then each of the many processes of a test run compiles every module again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo quick test test-hosts durations test-slow campaigns check docs wheel try-wheel bench setup-demo setup-dev setup-test setup-hosts setup-quick setup-docs

demo: setup-demo
	$(PY) -m ngpt demo -o demo --force

# A file runs in one process, so that what its tests share is built once.
WORKERS = -n auto --maxprocesses 4 --dist loadfile

# One minute on two cores: all that neither renders, trains, exports, evaluates, compiles nor starts programs. See conftest.py.
quick: setup-quick
	$(PY) -m pytest -q $(WORKERS) -m quick

# A law of a sampler that has passed with the same code on this machine is skipped, unless NGPT_STRICT=1:
# tests/data_gen/laws/conftest.py.
test: setup-test
	$(PY) -m pytest -q $(WORKERS) -m "not slow and not hosts and not browser"

# What needs a compiler, Node or a browser.
test-hosts: setup-hosts
	$(PY) -m pytest -q $(WORKERS) -m "not slow and (hosts or browser)"

# The processor seconds of all of them, in tests/durations.json.
durations: setup-test setup-hosts
	NGPT_STRICT=1 $(PY) -m pytest -q $(WORKERS) -m "not slow" --durations-to tests/durations.json

test-slow: setup-test setup-hosts
	$(PY) -m pytest -q -m slow --ignore tests/campaigns

# Bad inputs, kills, full disks and long runs in their long form, and the page of what came out (an hour or several).
campaigns: setup-test setup-hosts
	$(PY) scripts/reliability.py

check: setup-dev docs
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy
	$(PY) -m pytest -q tests/test_rooms.py
	$(PY) scripts/supply.py check

# The pages as a site, with search and a reference of the Python interface: out/site/index.html. Strict: a link that
# leads nowhere fails.
docs: setup-docs
	NO_MKDOCS_2_WARNING=1 $(PY) -m mkdocs build --strict --config-file scripts/site/mkdocs.yml

# A file that pip installs elsewhere: dist/ngpt_recon-VERSION-py3-none-any.whl.
wheel: setup-dev
	$(PY) -m hatchling build -t wheel -d dist

# The same, and each extra of it tried in a fresh environment (some 10 minutes).
try-wheel: setup-dev
	$(PY) -m scripts.wheel -o dist

# Are errors and FLIP of sixteen scenes still those in git? docs/lab/panel.md.
bench: setup-dev
	$(PY) -m bench.panel

setup-demo:
	@scripts/setup render llvm

setup-dev:
	@scripts/setup dev llvm

setup-test:
	@scripts/setup dev llvm programs

setup-hosts:
	@scripts/setup dev llvm chromium hosts

setup-quick:
	@scripts/setup dev

setup-docs:
	@scripts/setup docs
