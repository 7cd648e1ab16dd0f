#!/usr/bin/env bash
# Every comparison of docs/comparison.md, one after the other: bash benchmarks/run.sh [JOB ...]
# Jobs: machine steps rivals long ablation lighting emission sparse (default: all; hours).
# STAIRCASE takes part where STAIRCASE names its data set (docs/staircase.md says how to make it).
# Runs are kept in build/bench; what is finished is not done again. Results: benchmarks/results.
set -euo pipefail
cd "$(dirname "$0")/.."
unbake=${UNBAKE:-.venv/bin/unbake}
python=${PYTHON:-.venv/bin/python}
work=${WORK:-build/bench}
results=${RESULTS:-benchmarks/results}
ladder="direct with-prior with-stop-gradient with-second-bounce ours no-prior"
mkdir -p "$work" "$results"

data() { # NAME [OPTION ...]: capture a built-in scene once
    [ -d "$work/$1" ] || "$unbake" capture "$1" --out "$work/$1" "${@:2}"
}
on_demo() { data demo; }
on_still() { data still --views 25 --held-out 4 --spp 400; }
staircase() { [ -n "${STAIRCASE:-}" ] || { echo "STAIRCASE is not set: left out"; return 1; }; }
summary() { "$python" benchmarks/summary.py "$@"; }

steps() {
    local methods="ours direct no-prior ad-pt ad-pt:neural:split-halves prb prb:neural:split-halves
        ours:bitmap prb:bitmap prb:bitmap:split-halves ours:grid prb:grid prb:grid:split-halves"
    on_demo
    "$unbake" bench methods --data "$work/demo" --methods $methods --out "$results/methods-demo.json"
    staircase || return 0
    "$unbake" bench methods --data "$STAIRCASE" --methods $methods \
        --settings benchmarks/staircase.toml --out "$results/methods-staircase.json"
}
machine() { # where the time of a step goes on this machine
    local method files=()
    on_demo
    for method in ours ours:bitmap no-prior direct prb; do
        files+=("$work/step-${method/:/-}.json")
        "$unbake" bench step --data "$work/demo" --methods $method --out "${files[-1]}"
    done
    if staircase; then
        files+=("$work/step-staircase.json")
        "$unbake" bench step --data "$STAIRCASE" --settings benchmarks/staircase.toml --steps 40 \
            --out "${files[-1]}"
    fi
    "$python" benchmarks/machine.py "$results" "${files[@]}"
}
rivals() { # equal time, and equal samples
    local methods="ours prb prb:neural:split-halves prb:bitmap ad-pt:neural:split-halves direct
        no-prior"
    on_demo
    "$unbake" compare "$work/demo" --methods $methods --seconds 90 --out "$work/rivals-demo"
    summary "$results/rivals-demo.json" "$work/rivals-demo"
    "$unbake" compare "$work/demo" --methods ours prb --steps 2400 --out "$work/equal-demo"
    summary "$results/equal-demo.json" "$work/equal-demo"
    staircase || return 0
    "$unbake" compare "$STAIRCASE" --methods ours prb ad-pt:neural:split-halves direct no-prior \
        --seconds 180 --evaluate-spp 16 --settings benchmarks/staircase.toml \
        --out "$work/rivals-staircase"
    summary "$results/rivals-staircase.json" "$work/rivals-staircase"
}
long() { # what PRB ends with after 20 minutes; the runs of `rivals` tell when ours has it
    on_demo
    "$unbake" compare "$work/demo" --methods prb --seconds 1200 --out "$work/long-demo"
    summary "$results/long-demo.json" "$work/long-demo"
    staircase || return 0
    "$unbake" compare "$STAIRCASE" --methods prb --seconds 1200 --evaluate-spp 16 \
        --settings benchmarks/staircase.toml --out "$work/long-staircase"
    summary "$results/long-staircase.json" "$work/long-staircase"
}
ablation() {
    on_demo
    on_still
    for seed in 0 1 2; do
        "$unbake" compare "$work/demo" --methods $ladder --steps 2400 --score-seconds 0 \
            --seed $seed --out "$work/ablation-$seed"
        "$unbake" compare "$work/still" --methods $ladder --steps 1200 --score-seconds 0 \
            --unknown lighting --seed $seed --out "$work/ablation-light-$seed"
    done
    summary "$results/ablation-materials.json" "$work"/ablation-[0-9]
    summary "$results/ablation-lighting.json" "$work"/ablation-light-[0-9]
}
lighting() { # materials and lighting, alone and together
    on_still
    for unknown in materials lighting materials+lighting; do
        "$unbake" compare "$work/still" --methods ours --steps 2400 --score-seconds 0 \
            --unknown $unknown --out "$work/still-$unknown"
        summary "$results/still-$unknown.json" "$work/still-$unknown"
    done
}
emission() {
    on_demo
    "$unbake" compare "$work/demo" --methods ours --steps 2400 --score-seconds 0 \
        --unknown emission --out "$work/emission"
    summary "$results/emission.json" "$work/emission"
}
sparse() { # 6 views, with and without regularization
    [ -d "$work/few" ] || "$unbake" capture demo --views 6 --out "$work/few"
    for name in none smooth tied both; do
        "$unbake" compare "$work/few" --methods ours --steps 2400 --score-seconds 0 \
            --settings "benchmarks/sparse/$name.toml" --out "$work/sparse-$name"
        summary "$results/sparse-$name.json" "$work/sparse-$name"
    done
}

for job in ${@:-machine steps rivals long ablation lighting emission sparse}; do
    "$job"
done
