#!/usr/bin/env bash
# `lab/gpu_half_hour.sh pack` and `loads`: what a borrowed GPU machine lacks, in loads of the size of a call.
set -euo pipefail
cd "$(dirname "$0")/.."

MISSING='mitsuba drjit openexr pyamg trimesh'  # of what pyproject.toml asks for; the rest is there
PLUGINS='area|bitmap|box|conductor|constant|d65|diffuse|directional|gaussian|hdrfilm|independent|irregular|measured|merge'
PLUGINS+='|obj|orthographic|path|perspective|ply|point|rectangle|regular|serialized|sphere|srgb|twosided|uniform'
: "${CALL_BYTES:=$((63 << 20))}"  # that travel in a call, the working tree included
: "${LIGHTSET:=assets/weights/lightset.safetensors}" "${FRAMES:=assets/weights/frames.safetensors}"  # `shipped:` there
PYTHON=.venv/bin/python

pack() {
  local name version llvm platforms=()
  rm -rf .gpu && mkdir -p .gpu/site .gpu/llvm/usr/lib .gpu/wheels
  for name in 17 24 27 28 31 34 35; do platforms+=(--platform "manylinux_2_${name}_x86_64"); done
  for name in $MISSING; do  # the versions in use here
    version=$("$PYTHON" -c "from importlib.metadata import version; print(version('$name'))")
    "$PYTHON" -m pip download -q --no-deps --only-binary=:all: --python-version 3.12 --implementation cp \
      "${platforms[@]}" -d .gpu/wheels "$name==$version"
  done
  for name in .gpu/wheels/*.whl; do "$PYTHON" -m zipfile -e "$name" .gpu/site; done
  leave_out_the_unused
  llvm=$("$PYTHON" - "$LIGHTSET" "$FRAMES" << 'PY'
import shutil, sys
from render.backend.variant import choose
from render.shapes.primitives import bunny_file
from sdps.models.checkpoint import load_weights, save_weights
for name, file in zip(("lightset", "frames"), sys.argv[1:]):
    save_weights(f".gpu/site/{name}.safetensors", load_weights(file), half=True)
shutil.copy(bunny_file(), ".gpu/site")
print(choose().llvm)
PY
  )
  # libLLVM, which only llvm_ad_rgb needs, and what it asks for, but not what every machine has.
  { echo "$llvm"; LD_LIBRARY_PATH=$(dirname "$llvm") ldd "$llvm" | grep -o '/[^ ]*'; } |
    grep -vE '/(ld-linux|lib(c|m|z|gcc_s|stdc\+\+)\.so)' | xargs cp -L -t .gpu/llvm/usr/lib
  for name in site llvm; do tar -C ".gpu/$name" -c . | nice xz -T0 --x86 --lzma2=preset=6 > ".gpu/$name.tar.xz"; done
  rm -rf .gpu/site .gpu/llvm .gpu/wheels
  # A few scenes, to see whether training works before any are rendered there.
  "$PYTHON" -m pipelines.cli render-data --preset world --out .gpu/probe --workers 1 --set data.seed=1 --set data.validation=0.2 \
    --set 'data.families={sculpture: 3, blobby: 3}' > /dev/null
  loads
}

leave_out_the_unused() { # other variants, plugins, headers, tests: two thirds of the bytes
  local mitsuba=.gpu/site/mitsuba
  find $mitsuba -maxdepth 1 -regex '.*/\(scalar\|cuda_ad\|llvm_ad\)_.*' ! -name '*_rgb.*' -delete
  find $mitsuba/plugins -name '*.so' | grep -vE "/($PLUGINS)\.so" | xargs rm
  rm -rf $mitsuba/data/srgb.coeff .gpu/site/*/include
  find .gpu/site \( -name '*.pyi' -o -name tests \) -prune -exec rm -rf {} +
}

loads() { # .gpu/1, .gpu/2, ...: pieces of the archives, each named ARCHIVE.PIECEofPIECES
  local tree room load=1 used=0 name piece count size
  rm -rf .gpu/[0-9]*
  tree=$({ git ls-files -z --cached --others --exclude-standard | xargs -0 stat -c %s || true; } 2> /dev/null |
    awk '{n += $1} END {print n}')
  room=$((CALL_BYTES - tree))
  ((room > 5000000)) || { echo "the working tree (${tree} bytes) leaves no room in a call" >&2; return 2; }
  for name in site llvm; do
    split -d -b "$room" ".gpu/$name.tar.xz" ".gpu/$name.piece"
    count=$(find .gpu -name "$name.piece*" | wc -l)
    for piece in ".gpu/$name.piece"*; do
      size=$(stat -c %s "$piece")
      ((used + size <= room)) || load=$((load + 1)) used=0
      used=$((used + size))
      mkdir -p ".gpu/$load" && mv "$piece" ".gpu/$load/$name.${piece##*piece}of$count"
    done
  done
  echo "The working tree has $((tree >> 20)) MiB of the 64 in a call. Call after call, within 30 s, timeout_s 600:"
  for name in $(seq "$load"); do
    echo "  carry [\".gpu/$name\"] ($(du -sm ".gpu/$name" | cut -f1) MiB)  command: bash lab/gpu_half_hour.sh go"
  done
  echo "  The first may carry .gpu/probe too ($(du -sm .gpu/probe 2> /dev/null | cut -f1) MiB) and run: bash lab/gpu_half_hour.sh probe"
  echo "  libLLVM is needed only where the probe says that OptiX does not work."
  echo "  nothing carried           command: bash lab/gpu_half_hour.sh go   (until it says: all done)"
  echo "In fewer calls: git sparse-checkout set --no-cone '/*' '!/docs/images/' '!/assets/weights/*.safetensors' '!/tests/'"
  echo "  then lab/gpu_half_hour.sh loads; before \`test\`: git sparse-checkout disable"
}

case ${1:-pack} in
  pack) pack ;;
  loads) loads ;;
  *) echo "$0: pack or loads" >&2; exit 2 ;;
esac
