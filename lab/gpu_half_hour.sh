#!/usr/bin/env bash
# Half an hour of a borrowed GPU machine without network: render scenes of `world`, train lightset and frames further.
#
#   lab/gpu_half_hour.sh pack           here: what the machine lacks, into .gpu/, in loads that fit a call; says what to run
#   lab/gpu_half_hour.sh loads          here: the loads again, after the working tree became smaller
#   lab/gpu_half_hour.sh go [MINUTES]   there, as often as needed: unpack, render, train, test; stops after MINUTES (9)
#   lab/gpu_half_hour.sh try            here: `go`, tiny, on the CPU, in five minutes; installs nothing
#
# `go` begins where the one before ended, while the machine is held. Every two minutes, and when it ends, the weights so far
# (float16), curves and logs are copied into $OUT: eight files.
set -euo pipefail
cd "$(dirname "$0")/.."

# The plan of the half hour; all can be set from outside: RENDER_MINUTES=8 lab/gpu_half_hour.sh go
: "${RENDER_MINUTES:=6}" "${LIGHTSET_MINUTES:=8}" "${FRAMES_MINUTES:=8}" "${BRING_SECONDS:=120}"
: "${LIGHTSET:=assets/weights/lightset.safetensors}" "${FRAMES:=assets/weights/frames.safetensors}"  # training starts there
: "${SEED:=20261501}"  # of the scenes: another for every half hour
: "${ROUNDS:=10}"  # parts of the plan, each with its share of every family; the first two compare GPU and CPU
: "${COMPARE_SECONDS:=50}"  # of each at most
: "${GPU_WORKERS:=12}" "${CPU_WORKERS:=$(nproc --all)}"  # shapes are made on the CPU: several processes keep one GPU busy
DATA=("data.seed=$SEED" data.prefix=g1- 'data.families={composition: 700, sculpture: 500, blobby: 300}')  # 6,000 scenes
# Loading binds: a core makes about eight samples a second, 15 processes two to four steps. Validation is rare, since one
# process loads it. Rates of 2e-3 were right for a quarter of these batches.
TRAINING='steps: null, skip_missing: true, cooldown: 0.7, warmup: 0.02, clip_gradient: 1.0, learning_rate: 3e-3, workers: 15,
  validation_images: 32, validation_scenes: 24, validate_every: 400, checkpoint_minutes: 1'
LIGHTSET_RUN='base: lightset, seed: 41, size: 64, images: 24, batch_scenes: 48, options: {nearness: true}'
FRAMES_RUN='base: frames, seed: 42, crop: 48, images: 20, batch_scenes: 32, accumulate: 4, loss: chord, light_blend: 1.5,
  light_error: 0.0, start_share: 0.5, lights: lightset-gpu'

: "${WORK:=/tmp/gpu}" "${OUT:=out/gpu_half_hour}" "${PYTHON:=python3}"  # WORK lies outside the checkout there
export OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 PYTHONUNBUFFERED=1

TINY=()  # settings of training that `try` adds

say() { echo "[$(date +%T)] $*"; }

go() { # SECONDS
  local code=0
  END=$(($(date +%s) + $1))
  mkdir -p "$OUT" "$WORK/logs" "$WORK/in" "$WORK/run"
  (while sleep "$BRING_SECONDS"; do bring; done) > /dev/null 2>&1 &
  BRINGING=$!
  trap 'kill "$BRINGING" 2> /dev/null || true; bring' EXIT
  take
  [[ -e $WORK/site ]] || { say "the next load, please"; return; }
  set_up
  [[ -e $WORK/rendered ]] || render
  train || code=$?
  if [[ $code == 124 ]]; then say "out of time; go on with: lab/gpu_half_hour.sh go"; return; fi
  test_gpu || say "test-gpu failed"
  say "all done; training ended with exit code $code"
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
  export PYTHONPATH=$PWD:$WORK/site SDPS_CACHE=$WORK
  cp -n "$WORK/site/StanfordBunny.ply" "$WORK" 2> /dev/null || true
  for name in LIBCUDA:libcuda.so LIBOPTIX:libnvoptix.so; do
    file=$({ find -L /usr/local/nvidia /usr/lib/x86_64-linux-gnu -maxdepth 2 -name "${name#*:}*" || true; } 2> /dev/null |
      sort | head -1)
    [[ ! $file ]] || export "DRJIT_${name%:*}_PATH=$file" LD_LIBRARY_PATH="${file%/*}:${LD_LIBRARY_PATH:-}"
    say "${name#*:}: ${file:-not found}"
  done
  file=$(find -L /usr/local/nvidia -name nvoptix.bin 2> /dev/null | head -1 || true)
  [[ ! $file || -e /usr/share/nvidia/nvoptix.bin ]] || { mkdir -p /usr/share/nvidia && ln -s "$file" /usr/share/nvidia/; }
  file=$("$PYTHON" -c "import mitsuba as mi; mi.set_variant('cuda_ad_rgb')
scene = mi.load_dict({'type': 'scene', 'sphere': {'type': 'sphere'}})
print('works:', scene.ray_test(mi.Ray3f([0, 0, 5], [0, 0, -1])))" 2>&1 | tail -n 1 || true)
  say "OptiX: $file"
  say "$(nvidia-smi -L 2> /dev/null || echo "no GPU here")"
}

until_then() { # SECOND COMMAND: ends it when `date +%s` says SECOND; it has half a minute to save what it has
  local left=$(($1 - $(date +%s)))
  ((left > 5)) || return 124
  timeout -k 30 "$left" "${@:2}"
}

render() { # the first rounds compare GPU and CPU, the faster one does the others, then what the first left
  local until=$(($(date +%s) + 60 * RENDER_MINUTES)) how best rates=() round
  for how in "cuda_ad_rgb:$GPU_WORKERS" "llvm_ad_rgb:$CPU_WORKERS"; do
    render_round $((${#rates[@]} + 1)) $(($(date +%s) + COMPARE_SECONDS)) "$how"
    rates+=("$RATE $how")
  done
  best=$(printf '%s\n' "${rates[@]}" | sort -rn | head -1)
  [[ $(count_scenes) != 0 ]] || { tail -n 3 "$WORK/logs/render.log"; say "nothing renders"; exit 2; }
  for round in $(seq 3 "$ROUNDS") 1 2; do
    (($(date +%s) + 5 < until)) && render_round "$round" "$until" "${best#* }"
  done
  touch "$WORK/rendered"
}

render_round() { # ROUND SECOND VARIANT:WORKERS; leaves scenes a minute in RATE
  local before code=0 began
  before=$(count_scenes) began=$(date +%s)
  SDPS_VARIANT=${3%:*} until_then "$(($2 < END ? $2 : END))" "$PYTHON" -m pipelines.cli render-data --preset world \
    --out "$WORK/run" "${DATA[@]/#/--set=}" --shard "$1/$ROUNDS" --workers "${3#*:}" >> "$WORK/logs/render.log" 2>&1 || code=$?
  RATE=$((60 * ($(count_scenes) - before) / ($(date +%s) - began + 1)))
  say "$3, round $1: $RATE scenes a minute, $(count_scenes) in all (exit code $code)"
}

count_scenes() { find "$WORK/run/data/shards" -name '*.exr' 2> /dev/null | wc -l; }

train() { # frames on the lights of lightset; a finished run is not begun again
  local code=0
  until_then "$END" "$PYTHON" -m pipelines.cli train --preset world --data "$WORK/run/data" --out "$WORK/run" \
    --models lightset-gpu,frames-gpu \
    --set "runs.lightset-gpu={$TRAINING, $LIGHTSET_RUN, minutes: $LIGHTSET_MINUTES, start: $WORK/site/lightset.safetensors}" \
    --set "runs.frames-gpu={$TRAINING, $FRAMES_RUN, minutes: $FRAMES_MINUTES, start: $WORK/site/frames.safetensors}" \
    "${TINY[@]}" >> "$WORK/logs/train.log" 2>&1 || code=$?
  tail -c 2000 "$WORK/logs/train.log" | tr '\r' '\n' | tail -n 5
  return $code
}

test_gpu() { # with the Python that is there, in place of the .venv that make would build
  local python
  python=$(command -v "$PYTHON")
  mkdir -p "$WORK/venv/bin"
  printf '#!/bin/sh\nexec "%s" "$@"\n' "$python" > "$WORK/venv/bin/python" && chmod +x "$WORK/venv/bin/python"
  touch "$WORK/venv/.ready" && touch "$WORK/venv/.assets-ready"
  until_then "$END" make test-gpu VENV="$WORK/venv" 2>&1 | tee "$WORK/logs/test-gpu.log" | tail -n 20
}

bring() { # into $OUT: for each run its last weights, else the best so far
  cp "$WORK"/logs/*.log "$WORK/run/data/preview.png" "$OUT" 2> /dev/null || true
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

make_tiny() { # the same code with other numbers, on what is here
  local name
  PYTHON=$PWD/.venv/bin/python WORK=${TRY_WORK:-/tmp/gpu_try} RENDER_MINUTES=1 LIGHTSET_MINUTES=0.3 FRAMES_MINUTES=0.3
  ROUNDS=3 COMPARE_SECONDS=30 BRING_SECONDS=20
  DATA+=('data.families={composition: 1, sculpture: 3, blobby: 4}' data.spp=2 data.light_count=6 data.size=64 data.views=1
    data.validation=0.3)
  for name in workers=0 images=4 batch_scenes=2 accumulate=1 validation_scenes=2 validation_images=4 validate_every=5; do
    TINY+=("--set=runs.lightset-gpu.$name" "--set=runs.frames-gpu.$name")
  done
  rm -rf "$WORK" && mkdir -p "$WORK/site"
  cp "$LIGHTSET" "$WORK/site/lightset.safetensors" && cp "$FRAMES" "$WORK/site/frames.safetensors"
}

case ${1:-} in
  pack | loads) exec lab/gpu_pack.sh "$1" ;;
  go) go $((60 * ${2:-9})) ;;
  try) make_tiny; (go "${TRY_SECONDS:-75}"); go 150 ;;  # the first is cut off
  *) sed -n '2,/^set/{/^set/d;s/^# \{0,1\}//p}' "$0"; [[ ${1:-} == --help ]] || exit 2 ;;
esac
