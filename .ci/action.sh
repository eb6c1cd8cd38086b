#!/usr/bin/env bash
# The GitHub Action's one step (action.yml): its inputs come as environment variables, so that no text of theirs is ever
# read as shell code. It ends with the status of export-model.
set -euo pipefail

lines() { # the lines of a variable that are not empty, without what surrounds them, into the array ITEMS
  ITEMS=()
  local line
  while IFS= read -r line; do
    line="${line#"${line%%[![:space:]]*}"}"
    line="${line%"${line##*[![:space:]]}"}"
    if [ -n "$line" ]; then ITEMS+=("$line"); fi
  done <<<"$1"
}

command="${EXPORT_MODEL_COMMAND:-verify}"
case "$command" in
  verify | compare) runtimes=(--runtimes "${EXPORT_MODEL_RUNTIMES:-auto}") ;;
  export) runtimes=(--verify "${EXPORT_MODEL_RUNTIMES:-auto}") ;;
  *)
    echo "::error title=export-model::command is '$command'; it is verify, compare or export" >&2
    exit 2
    ;;
esac
lines "${EXPORT_MODEL_PATHS:-}"
paths=("${ITEMS[@]}")
if [ "${#paths[@]}" -eq 0 ]; then
  echo "::error title=export-model::paths is empty; give one path per line" >&2
  exit 2
fi
lines "${EXPORT_MODEL_ARGUMENTS:-}"
arguments=("${ITEMS[@]}")

if [ -n "${EXPORT_MODEL_INSTALL:-}" ]; then
  # -I: the folder that the job stands in is the checked-out repository, whose pip.py would be run otherwise
  python -I -m pip install --quiet --disable-pip-version-check "$EXPORT_MODEL_INSTALL"
fi
if [ "${EXPORT_MODEL_JAVASCRIPT:-false}" = true ]; then
  export-model runtimes install tfjs
fi

report="${EXPORT_MODEL_REPORT:-parity}"
mkdir -p "$report"
summary=()
if [ -n "${GITHUB_STEP_SUMMARY:-}" ]; then summary=(--markdown "$GITHUB_STEP_SUMMARY"); fi

status=0
export-model "$command" "${runtimes[@]}" --junit "$report/parity.xml" --html "$report/parity.html" \
  "${summary[@]}" "${arguments[@]}" -- "${paths[@]}" || status=$?
if [ -n "${GITHUB_OUTPUT:-}" ]; then echo "status=$status" >>"$GITHUB_OUTPUT"; fi
if [ "$status" -ne 0 ]; then
  see=""
  if [ -f "$report/parity.html" ]; then see="; see $report/parity.html"; fi
  echo "::error title=export-model $command::ended with status $status$see" >&2
fi
exit "$status"
