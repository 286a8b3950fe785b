PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: scan test test-slow test-hardware fuzz check bench demo lock dist clean

# A fresh machine needs python >= 3.11 with pip and venv, and make; nothing else, no root.
$(VENV)/.installed: pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "scanmap needs Python 3.11 or newer; try: make PYTHON=python3.11")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --editable .
	touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	touch $@

scan: $(VENV)/.installed
	$(BIN)/scanmap scan --out room.ply

test: $(VENV)/.installed-dev
	$(BIN)/python -m pytest

test-slow: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -m slow

# SCANMAP_RIG=my-rig.toml make test-hardware: turns that head by 10 deg, its laser on. Stay beside it.
test-hardware: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -m hardware

# 100,000 inputs in a plain loop, then 15,000 of hypothesis.
fuzz: $(VENV)/.installed-dev
	$(BIN)/python benchmarks/fuzzing.py
	FUZZ_EXAMPLES=1500 $(BIN)/python -m pytest tests/test_fuzz.py

check: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest tests/test_architecture.py

bench: $(VENV)/.installed-dev
	$(BIN)/python benchmarks/laserline.py
	$(BIN)/python benchmarks/flanks.py
	$(BIN)/python benchmarks/pipeline.py
	$(BIN)/python benchmarks/scan.py
	$(BIN)/python benchmarks/grid.py
	$(BIN)/python benchmarks/recording.py
	$(BIN)/python benchmarks/twin.py
	$(BIN)/python benchmarks/hard_sweep.py
	$(BIN)/python benchmarks/sweeps.py
	$(BIN)/python benchmarks/mirrors.py
	$(BIN)/python benchmarks/ablation.py

lock:
	uv lock

dist: $(VENV)/.installed-dev
	$(BIN)/python -m build

clean:
	rm -rf $(VENV) dist build .mypy_cache .ruff_cache .pytest_cache

# The recording in recordings/: small enough to live in the repository.
demo: $(VENV)/.installed
	rm -f recordings/demo.mcap recordings/demo.rrd
	$(BIN)/scanmap scan --config twin-quick --record recordings/demo.mcap --rrd recordings/demo.rrd \
	  --set calibration.image.width=640 --set calibration.image.height=480 --set twin.sensor.jpeg_quality=80 \
	  --set view.image_width_px=320 --set view.image_every=2 --set view.thesis_every=10 \
	  --set view.thesis_width_px=240 --set view.max_points_per_shot=240 --set view.max_points_result=15000
