#!/usr/bin/env bash
# The whole way on a small room: capture a data set, fit it with the radiometric prior and with direct
# illumination alone, evaluate both, put them into one report. Finished stages are kept: FRESH=1 starts over.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
UNBAKE=.venv/bin/unbake
OUT=demo

[ -z "${FRESH:-}" ] || rm -rf "$OUT"
mkdir -p "$OUT/.done"
times=()

# stage NAME RESULT COMMAND...: runs the command that makes RESULT, from nothing, unless it once succeeded.
stage() {
  local name=$1 result=$2 start seconds
  shift 2
  if [ -e "$OUT/.done/$name" ] && [ -e "$result" ]; then
    times+=("$(printf '%-20s %6s s  (kept)' "$name" "$(cat "$OUT/.done/$name")")")
    return
  fi
  printf '\n== %s: %s\n' "$name" "$*"
  rm -f "$OUT/.done/$name"
  start=$(date +%s)
  "$@"
  [ -e "$result" ] || { printf 'demo: %s made no %s\n' "$name" "$result" >&2; exit 1; }
  seconds=$(($(date +%s) - start))
  echo "$seconds" >"$OUT/.done/$name"
  times+=("$(printf '%-20s %6s s' "$name" "$seconds")")
}

# What an interrupted stage left is no start for the next try.
discard_unless_done() { [ -e "$OUT/.done/$1" ] || rm -rf "${OUT:?}/$2"; }

# The last value of a key in a run's log.
last_logged() {
  .venv/bin/python - "$1/log.jsonl" "$2" <<'PY'
import json
import sys

path, key = sys.argv[1:]
with open(path, encoding="utf-8") as log:
    print([row[key] for row in map(json.loads, log) if key in row][-1])
PY
}

discard_unless_done capture data
stage capture "$OUT/data/transforms.json" "$UNBAKE" capture demo --out "$OUT/data"
discard_unless_done fit-ours ours
stage fit-ours "$OUT/ours/log.jsonl" "$UNBAKE" fit "$OUT/data" --out "$OUT/ours"
# As many steps. Searches of roughness are samples that ours has beside them: see the last lines.
steps=$(last_logged "$OUT/ours" step)
discard_unless_done fit-direct direct
stage fit-direct "$OUT/direct/log.jsonl" \
  "$UNBAKE" fit "$OUT/data" --out "$OUT/direct" --method direct --steps "$steps"
stage evaluate-ours "$OUT/ours/evaluation/metrics.json" "$UNBAKE" evaluate "$OUT/ours" --truth
stage evaluate-direct "$OUT/direct/evaluation/metrics.json" "$UNBAKE" evaluate "$OUT/direct"
# The report takes seconds and shows the newest of everything: always made again.
rm -f "$OUT/.done/report"
stage report "$OUT/report.html" "$UNBAKE" report "$OUT/ours" "$OUT/direct" --out "$OUT/report.html"

printf '\nsamples: ours %s, direct %s\n' "$(last_logged "$OUT/ours" samples)" "$(last_logged "$OUT/direct" samples)"
printf '%s\n' "${times[@]}"
printf '\nreport: %s/%s/report.html\n' "$PWD" "$OUT"
