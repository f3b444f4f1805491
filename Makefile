# Every target sets up what it needs, once: .venv, packages, a libLLVM that works, the bunny mesh.
#   make demo        render, train, evaluate and regenerate on the demo preset, then write a page
#   make test        the test-suite
PYTHON ?= python3
PRESET ?= small
OUT ?= out/$(PRESET)
SHAPES ?= sphere,bunny
MATERIALS ?= gold-metallic-paint,chrome,lambertian:0.5
LIGHTS ?= merltest
SET ?=
MITSUBA ?=
MODELS ?=
STREAM ?=
DATA ?=
RUNS ?=
DATASET ?= gourd-apple
BITS ?=
BEAR ?=
METHOD ?=
METHODS ?=
FIGURES ?=
PHOTOS ?=
SEED ?= 0
WORKERS ?= 2
INPUTS ?= 100000
MINUTES ?= 120
KILLS ?= 100
LOCK ?= requirements.lock
UV ?= uv

VENV := .venv
SDPS := $(VENV)/bin/sdps
LAB := $(VENV)/bin/python -m lab
READY := $(VENV)/.ready
ASSETS_READY := $(VENV)/.assets-ready
DOCS_READY := $(VENV)/.docs-ready
APP_READY := $(VENV)/.app-ready
SETTINGS := $(foreach item,$(SET),--set $(item))

.PHONY: help setup app doctor data-plan render-data data-status data-validate data-preview data-card train eval-merltest \
	regenerate models study eval-classical eval-photos eval-diligent eval-lights eval-figures infer report ship shipped-results demo test test-slow test-gpu fuzz faults lock lint bench bench-train bench-classical bench-infer bench-surface docs clean
.DEFAULT_GOAL := help

help:
	@echo "make app   a local page: photographs to surfaces, scenes to play with, data to look at"
	@echo "make demo | test | lint | bench | bench-train | models | doctor | docs"
	@echo "make render-data | train | eval-merltest   PRESET=smoke|demo|small|paper OUT=folder SET='section.field=value ...'"
	@echo "make train MODELS=lcnet,nenet,sdps-plus   also STREAM=1: render while training, store nothing"
	@echo "make study   every model of the paper on equal data and steps, then tables A and B"
	@echo "make eval-classical | bench-classical | eval-photos DATA=folder   the methods without learning"
	@echo "make eval-figures PRESET=...   the paper's figures; make report OUT=folder   one page of everything evaluated"
	@echo "make eval-diligent DATA=folder [BITS=16 BEAR=76] | eval-lights DATA=folder DATASET=gourd-apple|light-stage   [RUNS=trained]"
	@echo "make ship | shipped-results [DATA=DiLiGenT's folder]   trained weights into the package; their tables"
	@echo "make infer PHOTOS=folder [METHOD=pf14 RUNS=trained]   normals, lights, meshes and a page from photographs"
	@echo "make data-plan | data-status | data-validate | data-preview | data-card   PRESET=... OUT=folder"
	@echo "make fuzz INPUTS=100000 MINUTES=120 SEED=0   mutated files into every reader; a stopped run goes on"
	@echo "make faults KILLS=100   kills, Ctrl-C, full disks, lost folders during render, export, import, train, ship, ..."
	@echo "make regenerate   SHAPES=bunny MATERIALS=chrome,lambertian:0.5 LIGHTS=merltest OUT=folder [MITSUBA=1]"

# LOCK= goes without hashes, where an index has files of its own.
$(READY): pyproject.toml constraints.txt requirements.lock
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "$(PYTHON) is older than 3.11; name a newer one: make PYTHON=python3.12"; exit 2; }
	test -x $(VENV)/bin/python || $(PYTHON) -m venv $(VENV)
	$(if $(LOCK),$(VENV)/bin/python -m pip install --quiet --no-deps --require-hashes --requirement $(LOCK))
	$(VENV)/bin/python -m pip install --quiet --constraint constraints.txt --editable '.[test]'
	@touch $@

$(ASSETS_READY): $(READY)
	$(SDPS) doctor --fix
	@touch $@

$(DOCS_READY): $(READY)
	$(VENV)/bin/python -m pip install --quiet --constraint constraints.txt --editable '.[test,docs]'
	@touch $@

$(APP_READY): $(ASSETS_READY)
	$(VENV)/bin/python -m pip install --quiet --constraint constraints.txt --editable '.[test,app]'
	@touch $@

setup: $(ASSETS_READY)

app: OUT = out
app: $(APP_READY)
	$(SDPS) app '$(OUT)'

doctor: $(READY)
	$(SDPS) doctor

eval-merltest: $(ASSETS_READY)
	$(SDPS) evaluate merltest --preset $(PRESET) --out $(OUT) $(SETTINGS)

render-data: $(ASSETS_READY)
	$(SDPS) render-data --preset $(PRESET) --out $(OUT) $(SETTINGS)

train: $(ASSETS_READY)
	$(SDPS) train --preset $(PRESET) --out $(OUT) $(if $(MODELS),--models '$(MODELS)') $(if $(STREAM),--stream) $(SETTINGS)

models: $(READY)
	$(SDPS) models

# The study of docs/studies/model-comparison.md: every model, the same data and steps.
study: PRESET = lab/presets/study.yaml
study: OUT = out/study
study: $(ASSETS_READY)
	$(SDPS) render-data --preset $(PRESET) --out $(OUT) $(SETTINGS)
	$(SDPS) train --preset $(PRESET) --out $(OUT) --models '$(or $(MODELS),all)' $(SETTINGS)
	$(SDPS) evaluate merltest --preset $(PRESET) --out $(OUT) $(SETTINGS)

eval-classical: OUT = out/classical
eval-classical: $(ASSETS_READY)
	$(SDPS) evaluate classical --out $(OUT) $(SETTINGS)

eval-photos: OUT = out/photos
eval-photos: $(READY)
	$(SDPS) evaluate uw '$(DATA)' --out $(OUT)

eval-diligent eval-lights: OUT = out/real
eval-diligent: $(READY)
	$(SDPS) evaluate diligent '$(DATA)' --out $(OUT) $(if $(RUNS),--models $(RUNS)) $(if $(BITS),--bits $(BITS)) \
		$(if $(BEAR),--bear $(BEAR))

eval-lights: $(READY)
	$(SDPS) evaluate $(DATASET) '$(DATA)' --out $(OUT) $(if $(RUNS),--models $(RUNS))

eval-figures: $(ASSETS_READY)
	$(LAB) eval-figures --preset $(PRESET) --out $(OUT) $(if $(FIGURES),--figures '$(FIGURES)') \
		$(if $(METHODS),--methods '$(METHODS)') $(SETTINGS)

infer: OUT = out/infer
infer: $(READY)
	$(SDPS) infer '$(PHOTOS)' --out $(OUT) $(if $(METHOD),--method '$(METHOD)') $(if $(RUNS),--models $(RUNS))

# Weights of finished runs into assets/weights; then their tables, there and in docs/results.md. DATA: DiLiGenT's folder.
ship: PRESET = ship
ship: $(READY)
	$(LAB) ship --preset $(PRESET) --out $(OUT) $(if $(MODELS),--models '$(MODELS)')

shipped-results: OUT = out/shipped
shipped-results: PRESET = ship
shipped-results: $(ASSETS_READY)
	$(SDPS) evaluate merltest --preset $(PRESET) --out $(OUT) --set 'test.shipped=[all]' $(SETTINGS)
	$(if $(DATA),$(SDPS) evaluate diligent '$(DATA)' --out $(OUT) --methods '$(or $(METHODS),learned)')
	$(LAB) shipped-results --out $(OUT) --page docs/results.md

report: $(READY)
	$(SDPS) evaluate report $(OUT)

data-plan: $(ASSETS_READY)
	$(SDPS) data plan --preset $(PRESET) --out $(OUT) $(SETTINGS)

data-status data-validate data-preview data-card: $(READY)
	$(SDPS) data $(@:data-%=%) $(OUT)/data

regenerate: OUT = out/regenerated
regenerate: $(ASSETS_READY)
	$(SDPS) regenerate --preset $(PRESET) --shapes '$(SHAPES)' --materials '$(MATERIALS)' --light-set '$(LIGHTS)' \
		--out $(OUT) $(if $(MITSUBA),--mitsuba) $(SETTINGS)

demo: PRESET = demo
demo: $(ASSETS_READY)
	$(SDPS) demo --preset $(PRESET) --out $(OUT) --materials '$(MATERIALS)' --light-set '$(LIGHTS)' $(SETTINGS)

test: $(ASSETS_READY)
	OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 $(VENV)/bin/python -m pytest -n $(WORKERS) --dist worksteal -m "not slow and not gpu"

test-slow: $(ASSETS_READY)
	$(VENV)/bin/python -m pytest -m "slow and not gpu"

test-gpu: $(ASSETS_READY)
	$(VENV)/bin/python -m pytest -m gpu tests/test_gpu.py

# Mutated files into every reader, in child processes; stopped, it goes on where it was.
fuzz: OUT = out/fuzz
fuzz: $(ASSETS_READY)
	$(VENV)/bin/python tests/fuzz/fuzz_run.py --out $(OUT) --seed $(SEED) --inputs $(INPUTS) --minutes $(MINUTES)

# Kills, Ctrl-C, full disks, lost folders and more at random moments of long commands, KILLS times each; results are compared.
faults: OUT = out/faults
faults: $(ASSETS_READY)
	$(VENV)/bin/python tests/faults/fault_run.py --out $(OUT) --seed $(SEED) --kills $(KILLS)

# The hashes of what the set-up installs, but torch and what comes with it; needs uv.
UNHASHED := torch triton setuptools cuda-bindings cuda-pathfinder cuda-toolkit $(addprefix nvidia-,cublas cuda-cupti cuda-nvrtc \
	cuda-runtime cudnn-cu13 cufft cufile curand cusolver cusparse cusparselt-cu13 nccl-cu13 nvjitlink nvshmem-cu13 nvtx)
lock:
	head -2 requirements.lock > requirements.new
	$(UV) pip compile pyproject.toml --extra test --extra app --constraint constraints.txt --universal --python-version 3.11 \
		--generate-hashes --no-emit-index-url --no-annotate --no-header $(addprefix --no-emit-package ,$(UNHASHED)) >> requirements.new
	mv requirements.new requirements.lock

lint: $(READY)
	$(VENV)/bin/ruff check --no-cache .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy

bench: OUT = out/bench
bench: $(ASSETS_READY)
	$(LAB) bench --out $(OUT)

bench-train: OUT = out/bench-train
bench-train: $(READY)
	$(LAB) bench-train --out $(OUT)

bench-classical: OUT = out/bench-classical
bench-classical: $(READY)
	$(LAB) bench-classical --out $(OUT)

bench-infer: OUT = out/bench-infer
bench-infer: $(READY)
	$(LAB) bench-infer --out $(OUT) $(if $(QUICK),--quick,--large) $(if $(METHODS),--methods '$(METHODS)') $(if $(RUNS),--models $(RUNS))

bench-surface: OUT = out/bench-surface
bench-surface: $(READY)
	$(LAB) bench-surface $(DATA) --out $(OUT)

# Into out/site; nothing is fetched but the packages, once.
docs: $(DOCS_READY)
	NO_MKDOCS_2_WARNING=1 $(VENV)/bin/python -m mkdocs build

clean:
	rm -rf $(VENV) out build *.egg-info
