# Everything runs in .venv, which the first target that needs it creates.
#   make demo    train, evaluate and record an agent that picks blocks
#   make tables  fill the documentation's tables from docs/data
#   make test    what continuous integration runs: lint, types, tests
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV ?= .venv
BIN := $(VENV)/bin
DEMO_LOGS ?= logs/demo
DEMO = --baseline equi_sacfd --env BulletArm/CloseLoopBlockPicking-v0 --preset quick -f $(DEMO_LOGS)
PYTEST_FLAGS ?=

.PHONY: venv demo tables images test lint format type selfcheck docs clean
.DEFAULT_GOAL := venv

venv: $(VENV)/installed-dev

# A stamp file for each extra: it is installed again when the requirements change.
$(VENV)/installed-%: pyproject.toml constraints.txt
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[$*]"
	@touch $@

demo: venv
	$(BIN)/bulletarm-zoo train $(DEMO) --seed 0 -n 250 --eval-freq 25 --progress
	$(BIN)/bulletarm-zoo record $(DEMO) --load-last -n 4 -o $(DEMO_LOGS)/demo.gif
	$(BIN)/bulletarm-zoo enjoy $(DEMO) --load-last -n 50

tables: venv
	$(BIN)/python tools/fill_tables.py docs README.md CONTRIBUTING.md

# The self-check compiles the numeric code once, so that the two workers of pytest do not. The last line of the output
# is the summary of pytest.
test: venv
	@$(MAKE) --no-print-directory -j 2 lint type selfcheck
	$(BIN)/python -m pytest -n 2 --dist worksteal -q $(PYTEST_FLAGS)

lint: venv
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: venv
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

type: venv
	$(BIN)/mypy

selfcheck: venv
	$(BIN)/python -m bulletarm_gym.check --seconds 0.1

docs: $(VENV)/installed-docs
	$(BIN)/mkdocs build --strict

# Images of all tasks and chart of success rates in docs/images.
images: venv
	$(BIN)/python tools/draw_gallery.py -o docs/images/tasks --heightmap --pixels 560
	$(BIN)/python tools/draw_success.py CloseLoop -o docs/images/success_closed_loop.png

clean:
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .pytest_cache .ruff_cache site
