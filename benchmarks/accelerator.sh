#!/usr/bin/env bash
# Measure an accelerator that is there for a quarter of an hour, and train the paper's setting on it.
#
#   benchmarks/accelerator.sh measure OUT                      physics backends, reward fitting, an iteration's parts
#   benchmarks/accelerator.sh train OUT SECONDS [OPTION ...]   begin OUT/run, or continue it, for at most SECONDS
#   benchmarks/accelerator.sh pack OUT                         OUT/run as OUT/packed/run.tar.gz.aa and so on
#   benchmarks/accelerator.sh unpack FOLDER OUT                OUT/run from such files
#
# Every step has a time limit and a log of its own in OUT, and a step that fails does not stop the next. OPTIONs go to
# `fmpjax train`, for example --motion FILE --frames 2370:2580. A run that was packed here continues on another machine:
# unpack it, then `fmpjax train --resume --run OUT/run`.
#
# PYTHON names the interpreter, LIMIT a step's seconds (100). SMOKE=1 makes everything small, to try it on a CPU.
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
PYTHON=${PYTHON:-python}
export PYTHONUNBUFFERED=1
PIECE=15M # of a packed run: some ways home take no larger files

usage() {
  sed -n '/^#   /s/^# //p' "${BASH_SOURCE[0]}" >&2
  exit 2
}

# step NAME SECONDS COMMAND ...: its output goes to OUT/NAME.log and to the screen.
step() {
  local name=$1 limit=$2 began=$SECONDS
  shift 2
  echo "== $name, at most $limit s"
  timeout --signal=INT --kill-after=20 "$limit" "$@" 2>&1 | tee "$out/$name.log"
  echo "== $name: exit ${PIPESTATUS[0]} after $((SECONDS - began)) s"
}

measure() {
  local batches=(1024 4096) rounds=3 backends=(native mjx-warp mjx-jax)
  local fit=(--rounds 5) parts=(paper --rounds 3 --csv "$out/parts.csv")
  if [ -n "${SMOKE:-}" ]; then
    batches=(4) rounds=1 backends=(native mjx-warp)
    fit=(--rounds 1 --no-whole --environments 16)
    parts=(smoke --rounds 1 --csv "$out/parts.csv")
  fi
  step machine 20 "$PYTHON" -c 'import jax; print(jax.__version__, jax.devices())'
  # A backend and a batch at a time: each table is whole whatever becomes of the next.
  for backend in "${backends[@]}"; do
    for batch in "${batches[@]}"; do
      step "physics-$backend-$batch" "${LIMIT:-100}" "$PYTHON" benchmarks/physics.py \
        --preset paper --backends "$backend" --batches "$batch" --rounds "$rounds"
    done
  done
  step fit "${LIMIT:-100}" "$PYTHON" benchmarks/fit.py "${fit[@]}"
  step parts "$((2 * ${LIMIT:-100}))" "$PYTHON" benchmarks/throughput.py "${parts[@]}"
}

train() {
  local seconds=$1 begin=(--preset paper --reset fixed --method fmp)
  shift
  [ -n "${SMOKE:-}" ] && begin=(--preset smoke --reset fixed)
  if [ -f "$out/run/config.json" ]; then begin=(--resume); fi
  # SIGTERM makes a run save and end, without the evaluation and the film of a run that ends by itself.
  echo "== train, at most $seconds s"
  timeout --signal=TERM --kill-after=90 "$seconds" \
    "$PYTHON" -m fmpjax.cli train "${begin[@]}" --run "$out/run" "$@" 2>&1 | tee -a "$out/train.log"
  echo "== train: exit ${PIPESTATUS[0]}"
}

# Of the states the newest and the best: with them a run continues, and shows what it has.
pack() {
  local newest
  newest=$(ls "$out/run/checkpoints" 2>/dev/null | grep -E '^[0-9]+$' | sort -n | tail -1)
  mkdir -p "$out/packed"
  rm -f "$out/packed"/run.tar.gz.*
  (
    cd "$out" || exit
    find run -path run/checkpoints -prune -o -print
    [ -z "$newest" ] || find "run/checkpoints/$newest"
  ) | tar -C "$out" -czf - --no-recursion -T - | split -b "$PIECE" - "$out/packed/run.tar.gz."
  ls -l "$out/packed"
}

command=${1:-}
case $command in
  measure | pack) [ $# -eq 2 ] || usage ;;
  train) [ $# -ge 3 ] || usage ;;
  unpack)
    [ $# -eq 3 ] || usage
    mkdir -p "$3" && cat "$2"/run.tar.gz.* | tar -C "$3" -xzf -
    exit
    ;;
  *) usage ;;
esac
mkdir -p "$2"
out=$(cd "$2" && pwd)
shift 2
"$command" "$@"
