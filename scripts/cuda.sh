#!/usr/bin/env bash
# All there is to measure on a machine with an NVIDIA GPU, also one without a package registry:
#   bash scripts/cuda.sh OUT [JOB ...]          jobs: doctor tests step methods cube staircase
#
#   SCALE       paper (default), or smoke: the same in a minute, on a CPU, to see that it runs
#   PYTHON      the interpreter (default: python3)
#   SITE        a folder with the dependencies, if they are not installed
#   STAIRCASE   a data set, as docs/staircase.md makes it; without it STAIRCASE is left out
#   MINUTES     how long `staircase` may take in one call (default: 8); the next call goes on
#
# Results go to OUT: text, and JSON as `unbake bench` and `unbake compare` write it.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
[ -n "${1:-}" ] || { sed -n '2,11p' "$0" | cut -c3-; exit 2; }
out=$1
shift
scale=${SCALE:-paper}
python=${PYTHON:-python3}
export PYTHONPATH="${SITE:+$SITE:}src${PYTHONPATH:+:$PYTHONPATH}"
mkdir -p "$out"
unbake() { "$python" -m unbake "$@"; }
say() { printf '== %s\n' "$*"; }

case $scale in
paper)
  size=(--views 8 --held-out 1 --resolution 256 --spp 32)
  steps=100 grid=256 pixels=65536 spp=16 albedos=(0.3 0.5 0.7 0.9 0.95 0.97)
  printf 'preset = "paper"\n' >"$out/step.toml"
  ;;
smoke)
  size=(--views 2 --held-out 1 --resolution 16 --spp 4)
  steps=10 grid=8 pixels=64 spp=4 albedos=(0.3)
  {
    printf 'pixels = 64\nspp = 4\nsteps = 20\n'
    for net in albedo roughness radiance; do
      printf '[%s]\nwidth = 8\nhidden = 1\n[%s.grid]\nlevels = 2\ntable_log2 = 8\n' $net $net
    done
  } >"$out/step.toml"
  ;;
*)
  echo "SCALE is paper or smoke, not $scale" >&2
  exit 2
  ;;
esac

data() { [ -d "$out/data/$1" ] || unbake capture "${@:2}" --out "$out/data/$1" "${size[@]}"; }

doctor() {
  { nvidia-smi || echo "no nvidia-smi"; ldconfig -p | grep -E 'nvoptix|libcuda' || true; } \
    >"$out/machine.txt" 2>&1
  unbake doctor | tee "$out/doctor.txt"
}
tests() { "$python" -m pytest -q -m "not slow" tests 2>&1 | tee "$out/tests.txt"; }
step() { # where the time of a step goes, and how far it is from the floor
  data demo demo
  for method in ours prb ad-pt; do
    unbake bench step --data "$out/data/demo" --methods $method --settings "$out/step.toml" \
      --steps $steps --out "$out/step-$method.json"
  done
}
methods() { # step times side by side
  data demo demo
  unbake bench methods --data "$out/data/demo" --methods ours direct no-prior prb ad-pt ours:bitmap \
    prb:bitmap --settings "$out/step.toml" --steps $steps --out "$out/methods.json"
}
cube() { # Fig. 5: dense grids, ever longer paths; the limits of Table 2
  local limits=(0.3:5 0.5:7 0.7:13 0.9:42 0.95:84 0.97:140) albedo limit
  for albedo in "${albedos[@]}"; do
    for limit in "${limits[@]}"; do
      if [ "${limit%:*}" = "$albedo" ]; then break; fi
    done
    "$python" - "$out/data/scene-$albedo" "$albedo" <<'PY'
import sys
from pathlib import Path

from unbake import activate
from unbake.data.procedural import write_scene

activate()
write_scene("cube", Path(sys.argv[1]), albedo=float(sys.argv[2]))
PY
    data "cube-$albedo" "$out/data/scene-$albedo/scene.xml"
    cat >"$out/cube-$albedo.toml" <<TOML
pixels = $pixels
spp = $spp
radiance_spp = 0
radiance_representation = "grid"
[grid]
albedo = $grid
roughness = $grid
radiance = $grid
[path]
max_depth = ${limit#*:}
TOML
    for method in ours prb ad-pt; do # each by itself: one may run out of memory
      unbake bench step --data "$out/data/cube-$albedo" --methods $method:grid --steps $steps \
        --settings "$out/cube-$albedo.toml" --out "$out/cube-$albedo-$method.json" \
        || echo "$albedo $method failed" | tee -a "$out/cube-failed.txt"
    done
  done
}
staircase() { # 4.7 G samples at the paper's sizes, in slices that continue one another
  local scene=${STAIRCASE:-} resume=()
  if [ -z "$scene" ]; then
    [ "$scale" = smoke ] || { echo "STAIRCASE is not set: left out"; return; }
    data demo demo
    scene=$out/data/demo
  fi
  [ ! -f "$out/staircase/config.toml" ] || resume=(--resume)
  local length=()
  [ "$scale" = smoke ] && length=(--steps 20) || length=(--steps 18000)
  [ ${#resume[@]} -gt 0 ] || length+=(--settings "$out/step.toml")
  # SIGTERM ends a fit with a checkpoint; what it then says is no failure.
  timeout --signal=TERM "$((60 * ${MINUTES:-8}))" "$python" -m unbake fit "$scene" \
    --out "$out/staircase" "${length[@]}" "${resume[@]}" || [ $? -eq 124 ] || [ $? -eq 130 ]
  unbake evaluate "$out/staircase" --spp 64 --train-views 2
}

for job in ${@:-doctor tests step methods cube staircase}; do
  say "$job ($scale)"
  "$job"
done
