#!/usr/bin/env bash
# All there is to measure on a machine with an NVIDIA GPU, also one without a package registry:
#   bash scripts/cuda.sh OUT [JOB ...] [--plan] [--again]
#
#   jobs: doctor tests step methods staircase, and the paper's tables and figures: table1 table2 fig3
#   fig4 fig5 fig6 fig7 fig8
#
#   SCALE       paper (default), or smoke: the same at a size for a CPU, to see that it runs
#   PYTHON      the interpreter (default: python3)
#   SITE        a folder with the dependencies, if they are not installed
#   STAIRCASE   a data set, as docs/staircase.md makes it; without it `staircase` is left out
#   SCENES      folder of the published scenes; without it only table2 and fig5 are reproduced
#   STEPS       length of the fit of `staircase` (default: 18000; smoke: 20)
#   MINUTES     length of one call (default: 8). No job starts after it; `staircase`, tables and
#               figures stop and keep what they have. The same call goes on with what is left
#
# Results go to OUT: text, and JSON as `unbake bench` and `unbake compare` write it. Jobs that are
# done are not repeated; --again repeats those that are named, --plan only shows what is left.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
[ -n "${1:-}" ] || { sed -n '2,20p' "$0" | cut -c3-; exit 2; }
export PYTHONPATH="${SITE:+$SITE:}src${PYTHONPATH:+:$PYTHONPATH}" MINUTES=${MINUTES:-8}
exec "${PYTHON:-python3}" scripts/cuda.py "$@"
