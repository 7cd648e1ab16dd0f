#!/usr/bin/env bash
# All there is to measure on a machine with an NVIDIA GPU, also one without a package registry:
#   bash scripts/cuda.sh OUT [JOB ...]
#
#   jobs: doctor tests step methods staircase, and the paper's tables and figures: table1 table2 fig3
#   fig4 fig5 fig6 fig7 fig8
#
#   SCALE       paper (default), or smoke: the same at a size for a CPU, to see that it runs
#   PYTHON      the interpreter (default: python3)
#   SITE        a folder with the dependencies, if they are not installed
#   STAIRCASE   a data set, as docs/staircase.md makes it; without it `staircase` is left out
#   SCENES      folder of the published scenes; without it only table2 and fig5 are reproduced
#   MINUTES     how long `staircase`, a table or a figure may take in one call (default: 8); the next
#               call goes on: with the same fit, or with the same part of a table or figure
#
# Results go to OUT: text, and JSON as `unbake bench` and `unbake compare` write it.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
[ -n "${1:-}" ] || { sed -n '2,16p' "$0" | cut -c3-; exit 2; }
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
  steps=100
  printf 'preset = "paper"\n' >"$out/step.toml"
  ;;
smoke)
  size=(--views 2 --held-out 1 --resolution 16 --spp 4)
  steps=10
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
# Tables and figures of the paper; each call goes on where the last one ended.
reproduce() {
  local status=0 scenes=(--scenes "${SCENES:-scenes}")
  case $1 in
  table2 | fig5) ;;
  *) [ -d "${scenes[1]}" ] || { echo "SCENES is not set: $1 is left out"; return; } ;;
  esac
  timeout --signal=TERM "$((60 * ${MINUTES:-8}))" "$python" -m unbake reproduce "$1" \
    --scale "$scale" --out "$out/reproduction" "${scenes[@]}" || status=$?
  # Stopped by the time that it was given, or from outside: no failure.
  [ $status -eq 0 ] || [ $status -eq 124 ] || [ $status -eq 130 ]
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

figures=(table1 table2 fig3 fig4 fig5 fig6 fig7 fig8)
[ $# -gt 0 ] || set -- doctor tests step methods staircase "${figures[@]}"
failed=
for job in "$@"; do
  say "$job ($scale)"
  case " ${figures[*]} " in
  *" $job "*) reproduce "$job" || failed+=" $job" ;; # the others are still worth their time
  *) "$job" ;;
  esac
done
[ -z "$failed" ] || { echo "failed:$failed" >&2; exit 1; }
