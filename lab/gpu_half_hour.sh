#!/usr/bin/env bash
# Half an hour of a borrowed GPU machine without network: render scenes of `world` and `ship`, and train lightset and frames
# on them meanwhile.
#
#   lab/gpu_half_hour.sh pack          here: what the machine lacks, into .gpu/, in loads that fit a call; says what to run
#   lab/gpu_half_hour.sh loads         here: the loads again, after the working tree became smaller
#   lab/gpu_half_hour.sh probe         there, with the first load: do training and OptiX work, and how fast? takes two minutes
#   lab/gpu_half_hour.sh go [SECONDS]  there, as often as needed: takes in what the call brought, starts what can be started,
#                                      says every minute how it goes, and returns after SECONDS (560) or when all is done
#   lab/gpu_half_hour.sh test          there: the tests that need a GPU; wants the whole working tree
#   lab/gpu_half_hour.sh try           here: the same, tiny, on the CPU, in two minutes; installs nothing
#
# What `go` starts runs on between calls while the machine is held: the next call must come within 30 s, and nothing else may
# run beside a call that outlasts it. Whenever `go` returns, the weights so far (float16), curves and logs lie in $OUT: eight
# files. Choose MINUTES so that training ends within a call. A part that failed is started again by the next call.
set -euo pipefail
cd "$(dirname "$0")/.."

# The plan of the half hour; all can be set from outside: MINUTES=15 lab/gpu_half_hour.sh go
: "${MINUTES:=20}"          # of training, both networks at the same time
: "${ENOUGH:=800}"          # scenes with which it begins
: "${SEED:=20261501}"       # of the scenes: another for every half hour
: "${ROUNDS:=8}"            # parts of the plan, each with its share of every family
: "${VARIANT:=auto}" # cuda_ad_rgb where OptiX works: 23 scenes a second beside 8 processes; else llvm_ad_rgb
: "${WORLD_WORKERS:=8}" "${SHIP_WORKERS:=5}" "${READERS:=2}" # shapes are made on the CPU
NEAR=(data.lights=mixed data.light_count=32 data.near_lights=0.5 'data.near_light_distance=[2.5, .inf]'
  data.near_light_spread=0.2 data.camera=mixed 'data.camera_distance=[1.34, .inf]')
WORLD=("data.seed=$SEED" data.prefix=g1- data.spp=8 'data.families={composition: 1000, sculpture: 1250, blobby: 750}')
SHIP=("data.seed=$SEED" data.prefix=g2- data.spp=8 "${NEAR[@]}" 'data.families={blobby: 1000, sculpture: 1500}')
# Scenes lie in the GPU's memory, and samples are made there: loader processes would make a tenth of them.
# Both runs are those of the preset, but for these settings.
TRAINING=(checkpoint_minutes=1 validation_scenes=24 'augmentation={sensor: {stops: [-4.0, 1.0], black_error: [-8.0, 8.0]}}')
LIGHTSET=(validate_every=2000)
FRAMES=(validate_every=1000 start=shipped:frames lights=shipped:lightset)

: "${WORK:=/tmp/gpu}" "${OUT:=out/gpu_half_hour}" "${PYTHON:=python3}" # WORK lies outside the checkout there
export MINUTES ENOUGH SEED ROUNDS VARIANT WORLD_WORKERS SHIP_WORKERS READERS WORK PYTHON TINY="${TINY:-}"
export OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 PYTHONUNBUFFERED=1

say() { echo "[$(date +%T)] $*"; }

go() { # SECONDS
  local end=$(($(date +%s) + $1)) last=0 part
  mkdir -p "$OUT" "$WORK/logs" "$WORK/in" "$WORK/run" "$WORK/mix/data/shards"
  trap bring EXIT
  take
  [[ -e $WORK/site ]] || { say "the next load, please"; return; }
  set_up
  while (($(date +%s) < end)); do
    if [[ $VARIANT != llvm_ad_rgb || -e $WORK/llvm || $TINY ]]; then # without OptiX libLLVM is waited for
      for part in world ship; do begin render "$part"; done
    fi
    if (($(count_scenes) >= ENOUGH)) && join_manifests; then
      for part in lightset frames; do begin train "$part"; done
    fi
    ! is_done train lightset || ! is_done train frames || { say "all done"; return; }
    (($(date +%s) < last + 60)) || { last=$(date +%s) && report; }
    sleep 2
  done
  report
}

take() { # what this call brought; an archive is unpacked when all its pieces are there
  local name pieces
  find .gpu -name '*of*' -exec cp -n -t "$WORK/in" {} + 2> /dev/null || true
  for name in site llvm; do
    pieces=("$WORK/in/$name."*of*)
    if [[ ! -e $WORK/$name && ${#pieces[@]} == "${pieces[0]##*of}" ]]; then
      cat "${pieces[@]}" | "$PYTHON" -c "import sys, tarfile
tarfile.open(fileobj=sys.stdin.buffer, mode='r|xz').extractall('$WORK/$name.new', filter='data')"
      mv "$WORK/$name.new" "$WORK/$name"
      say "$name unpacked, $(du -sm "$WORK/$name" | cut -f1) MiB"
    fi
  done
}

set_up() { # Dr.Jit and OptiX look for the driver's files where most machines have them, this one perhaps not
  local name file
  export PYTHONPATH=$WORK/code:$WORK/site SDPS_CACHE=$WORK
  if [[ ! -e $WORK/code ]]; then # what runs between calls is not to change with the working tree
    mkdir -p "$WORK/code.new" && cp -r render sdps pipelines lab assets pyproject.toml "$WORK/code.new"
    cp -n "$WORK"/site/*.safetensors "$WORK/code.new/assets/weights/" 2> /dev/null || true
    mv "$WORK/code.new" "$WORK/code"
  fi
  cp -n "$WORK/site/StanfordBunny.ply" "$WORK" 2> /dev/null || true
  for name in LIBCUDA:libcuda.so LIBOPTIX:libnvoptix.so; do
    file=$({ find -L /usr/local/nvidia /usr/lib/x86_64-linux-gnu -maxdepth 2 -name "${name#*:}*" || true; } 2> /dev/null |
      sort | head -1)
    [[ ! $file ]] || export "DRJIT_${name%:*}_PATH=$file" LD_LIBRARY_PATH="${file%/*}:${LD_LIBRARY_PATH:-}"
  done
  file=$(find -L /usr/local/nvidia -name nvoptix.bin 2> /dev/null | head -1 || true)
  [[ ! $file || -e /usr/share/nvidia/nvoptix.bin ]] || { mkdir -p /usr/share/nvidia && ln -s "$file" /usr/share/nvidia/; }
  if [[ ! -e $WORK/optix ]]; then
    "$PYTHON" -c "import mitsuba as mi; mi.set_variant('cuda_ad_rgb')
scene = mi.load_dict({'type': 'scene', 'sphere': {'type': 'sphere'}})
print('works:', scene.ray_test(mi.Ray3f([0, 0, 5], [0, 0, -1])))" 2>&1 | tail -n 1 > "$WORK/optix" || true
    say "OptiX: $(cat "$WORK/optix")"
    say "$(nvidia-smi -L 2> /dev/null || echo "no GPU here"), $(nproc --all) cores, $(free -g | awk '/Mem/ {print $7}') GiB free"
  fi
  if [[ $VARIANT == auto ]]; then
    VARIANT=llvm_ad_rgb
    ! grep -q '^works' "$WORK/optix" || VARIANT=cuda_ad_rgb
  fi
}

begin() { # render|train PART: in a session of its own, unless it runs or is done
  local name=$1-$2 pid
  pid=$(cat "$WORK/logs/$name.pid" 2> /dev/null || true)
  if is_done "$@" || { [[ $pid ]] && kill -0 "$pid" 2> /dev/null; }; then return 0; fi
  if [[ $pid && ! $CALL_BEGAN -nt $WORK/logs/$name.pid ]]; then return 0; fi # failed in this call: once is enough
  setsid bash "$0" "$@" >> "$WORK/logs/$name.log" 2>&1 < /dev/null &
  echo $! > "$WORK/logs/$name.pid"
  say "$name begins"
}

is_done() { [[ -e $WORK/logs/$1-$2.done ]]; }

render() { # world|ship
  local round workers settings
  workers=$([[ $1 == world ]] && echo "$WORLD_WORKERS" || echo "$SHIP_WORKERS")
  settings=("${WORLD[@]}")
  [[ $1 == world ]] || settings=("${SHIP[@]}")
  cd "$WORK/code" && mkdir -p "$WORK/$1/data"
  [[ -e $WORK/$1/data/shards ]] || ln -s "$WORK/mix/data/shards" "$WORK/$1/data/shards"
  for round in $(seq "$ROUNDS"); do
    SDPS_VARIANT=$VARIANT nice -n 10 "$PYTHON" -m pipelines.cli render-data --preset "$1" --out "$WORK/$1" \
      "${settings[@]/#/--set=}" ${TINY:+"${TINY_SCENES[@]/#/--set=}"} --shard "$round/$ROUNDS" --workers "$workers" || true
  done
  touch "$WORK/logs/render-$1.done"
}

count_scenes() { find "$WORK/mix/data/shards" -name '*.exr' 2> /dev/null | wc -l; }

join_manifests() { # of both presets, once both are planned
  [[ ! -e $WORK/mix/data/manifest.jsonl ]] || return 0
  [[ -e $WORK/world/data/manifest.jsonl && -e $WORK/ship/data/manifest.jsonl ]] || return 1
  cat "$WORK"/{world,ship}/data/manifest.jsonl > "$WORK/mix/data/manifest.new"
  cp "$WORK/world/data/config.yaml" "$WORK/mix/data/"
  mv "$WORK/mix/data/manifest.new" "$WORK/mix/data/manifest.jsonl"
}

train() { # lightset|frames
  cd "$WORK/code"
  learn "$1" "$WORK/mix/data" "$WORK/run" "minutes=$MINUTES" ${TINY:+"${TINY_TRAINING[@]}"}
  touch "$WORK/logs/train-$1.done"
}

learn() { # lightset|frames DATA OUT SETTING...
  local settings=("${TRAINING[@]}" "${LIGHTSET[@]}")
  [[ $1 == lightset ]] || settings=("${TRAINING[@]}" "${FRAMES[@]}")
  settings+=("workers=$READERS" "${@:4}")
  "$PYTHON" -m pipelines.cli train --preset world --data "$2" --out "$3" --models "$1-gpu" "${settings[@]/#/--set=runs.$1-gpu.}"
}

report() {
  local name
  say "$(count_scenes) scenes; $(nvidia-smi --query-gpu=utilization.gpu,memory.used --format=csv,noheader 2> /dev/null || true)" \
    "load $(cut -d' ' -f1 /proc/loadavg)"
  for name in "$WORK"/logs/*.log; do
    printf '  %s: ' "$(basename "$name" .log)" && tail -c 1500 "$name" | tr '\r' '\n' | grep -v '^ *$' | tail -n 1 | cut -c1-200 || echo
  done
}

bring() { # into $OUT: for each run its last weights, else the best so far, and a sheet of what was rendered
  tail -qn 40 "$WORK"/logs/*.log > "$OUT/logs.txt" 2> /dev/null || true
  cp "$WORK/world/data/preview.png" "$OUT" 2> /dev/null || true
  "$PYTHON" - "$WORK/run/models" "$OUT" << 'PY' || true
import shutil, sys
from pathlib import Path
from sdps.models.checkpoint import load_weights, save_weights
for run in Path(sys.argv[1]).glob("*-gpu"):
    kept = Path(sys.argv[2]) / run.name
    found = [path for end in ("", "-best") if (path := run / f"{run.name}{end}.safetensors").is_file()]
    if found:
        save_weights(kept.with_suffix(".safetensors"), load_weights(found[0]), half=True)
    if (run / "metrics.jsonl").is_file():
        shutil.copy(run / "metrics.jsonl", kept.with_suffix(".jsonl"))
PY
}

test_gpu() { # with the Python that is there, in place of the .venv that make would build
  local python
  set_up
  unset PYTHONPATH && export PYTHONPATH=$PWD:$WORK/site
  python=$(command -v "$PYTHON")
  mkdir -p "$WORK/venv/bin"
  printf '#!/bin/sh\nexec "%s" "$@"\n' "$python" > "$WORK/venv/bin/python" && chmod +x "$WORK/venv/bin/python"
  touch "$WORK/venv/.ready" "$WORK/venv/.assets-ready"
  make test-gpu VENV="$WORK/venv" 2>&1 | tail -n 40
}

probe() { # on the scenes in .gpu/probe, each network for itself; then the renderer on the GPU
  mkdir -p "$OUT" "$WORK/logs" "$WORK/in"
  take && set_up
  cp -r .gpu/probe "$WORK/probe" && cd "$WORK/code"
  local name
  for name in lightset frames; do
    learn "$name" "$WORK/probe/data" "$WORK/probe" "minutes=${PROBE_MINUTES:-0.4}" log_every=10 2>&1 |
      tr '\r' '\n' | tail -n 12 | cut -c1-400 || true
    tail -n 2 "$WORK/probe/models/$name-gpu/metrics.jsonl" || true
  done
  nvidia-smi --query-gpu=memory.total,memory.used --format=csv,noheader || true
  SDPS_VARIANT=cuda_ad_rgb timeout "${PROBE_SECONDS:-40}" "$PYTHON" -m pipelines.cli render-data --preset ship \
    --out "$WORK/probe/cuda" "${SHIP[@]/#/--set=}" --shard 1/20 --workers 8 2>&1 | tr '\r' '\n' | tail -n 3 | cut -c1-300 || true
  say "on the GPU: $(find "$WORK/probe/cuda/data/shards" -name '*.exr' 2> /dev/null | wc -l) scenes in ${PROBE_SECONDS:-40} s"
}

TINY_SCENES=('data.families={sculpture: 4, blobby: 6}' data.spp=2 data.light_count=10 data.size=64 data.views=1
  data.validation=0.3)
TINY_TRAINING=(images=6 fewest_images=4 batch_scenes=2 accumulate=1 validation_scenes=2 validation_images=4
  validate_every=5)

try() { # the same code with other numbers, on what is here
  export TINY=1 PYTHON=$PWD/.venv/bin/python WORK=${TRY_WORK:-/tmp/gpu_try} MINUTES=0.4 ENOUGH=10 ROUNDS=1
  export WORLD_WORKERS=1 SHIP_WORKERS=1 READERS=1
  rm -rf "$WORK" && mkdir -p "$WORK/site"
  bash "$0" go "${TRY_SECONDS:-40}" && bash "$0" go 240
}

case ${1:-} in
  pack | loads) exec lab/gpu_pack.sh "$1" ;;
  go) CALL_BEGAN=$(mktemp) && go "${2:-560}" ;;
  render | train) "$1" "$2" ;;
  probe) probe ;;
  test) test_gpu ;;
  try) try ;;
  *) sed -n '2,/^set/{/^set/d;s/^# \{0,1\}//p}' "$0"; [[ ${1:-} == --help ]] || exit 2 ;;
esac
