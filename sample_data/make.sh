#!/usr/bin/env bash
# Makes the sample stacks and their true motions again.
set -euo pipefail
cd "$(dirname "$0")"
program=${TRAP_MOTION:-../.venv/bin/trap-motion}
"$program" simulate --overwrite --config tumbling-grain.toml -o tumbling-grain.tif \
    --truth tumbling-grain-truth.h5 --background-out tumbling-grain-background.tif
"$program" simulate --overwrite --config turning-grain.toml -o turning-grain.avi \
    --truth turning-grain-truth.h5
