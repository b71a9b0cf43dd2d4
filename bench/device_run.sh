#!/usr/bin/env bash
# Measures a host with a GPU in one command and at most LIMIT seconds, the most important figures first.
#
# Usage: bench/device_run.sh DATA OUT
#
# DATA contains 1ubq, 2hhb, 1aon and 7cgo. After each step, OUT/results.jsonl gets a line with the step, its exit code,
# its seconds and its results, and OUT/log its output. A step that exceeds its time is stopped; the results of its
# finished cases count. Steps for which no time is left are listed as not run.
#
# Variables: BIN, the folder with `molmesh` and `molmesh-bench` (target/release); BEFORE, a `molmesh-bench` of another
# version to compare stages with; LIMIT, seconds (220); DEVICE (0); IDS, IDS_MANY, CASES and ATOMS, to measure other
# structures; RUNS (30).
set -uo pipefail

data=${1:?DATA, a folder with structures} out=${2:?OUT, a folder for the results}
bin=${BIN:-target/release} limit=${LIMIT:-220} device=${DEVICE:-0} runs=${RUNS:-30}
ids=${IDS-2hhb,1aon,7cgo} many=${IDS_MANY-1ubq,2hhb,1aon} cases=${CASES-2hhb-7.27M,1aon-0.5,7cgo-0.5}
last=${ids##*,}
# For `serve`. The command `mesh` chooses a backend only if no device is named.
[ -z "${DEVICE:-}" ] || export MOLMESH__DEVICES__USE=$device
bench=$bin/molmesh-bench
mkdir -p "$out"
: >"$out/log" >"$out/results.jsonl"
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
begin=$SECONDS

# Runs a step for at most the given number of seconds. The command writes its results to the file after `--json`.
step() {
    local name=$1 most=$2 left=$((limit - (SECONDS - begin))) start=$EPOCHREALTIME code=0 json=$scratch/$1.json
    shift 2
    if [ "$left" -lt 5 ]; then
        echo "{\"step\": \"$name\", \"exit\": null, \"not_run\": \"no time is left\"}" >>"$out/results.jsonl"
        return
    fi
    echo "== $name: ${*//JSON_FILE/$name.json}" | tee -a "$out/log"
    # The signal TERM ends the programs that a step has started as well; KILL follows where it does not.
    timeout --kill-after=2 "$((most < left ? most : left - 3))" "${@/JSON_FILE/$json}" >>"$out/log" 2>&1 || code=$?
    local ms=$(((${EPOCHREALTIME/./} - ${start/./}) / 1000)) result=null
    [ -s "$json" ] && result=$(tr -d '\n' <"$json")
    echo "{\"step\": \"$name\", \"exit\": $code, \"milliseconds\": $ms, \"result\": $result}" >>"$out/results.jsonl"
    echo "   exit $code, $ms ms"
}

stages=(gpu --device "$device" --data "$data" --compress quantize --runs "$runs" --only "$cases"
    ${ATOMS:+--atoms "$ATOMS"} --json JSON_FILE)
service=("$bench" service --binary "$bin/molmesh" --data "$data" --json JSON_FILE)

step stages 45 "$bench" "${stages[@]}" --check --overlap
[ -z "${BEFORE:-}" ] || step stages-before 30 "$BEFORE" "${stages[@]}"
step one-client 45 "${service[@]}" --backends cpu,gpu --ids "$ids" --requests 9 --clients 0
step many-clients 75 "${service[@]}" --backends cpu,gpu,auto --ids "$many" --requests 3 --seconds 3
step commands 45 env -u MOLMESH__DEVICES__USE "$bench" commands --binary "$bin/molmesh" --data "$data" --ids "$many,$last" --runs 3 --json JSON_FILE
step first-request 20 "${service[@]}" --backends gpu --ids "$last" --cold 3
step first-request-no-readback 20 "${service[@]}" --backends gpu --ids "$last" --cold 3 \
    -- --set devices.readback_bytes=0
echo "$((SECONDS - begin)) s; results: $out/results.jsonl"
