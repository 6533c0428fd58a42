#!/usr/bin/env bash
# Change fusion, files, mask, cues and poses in one place at a time; fail where the tests notice less than 85 % of it.
# cosmic-ray writes into the checkout that it runs in: run this in a copy, as `make mutants` does.
set -euo pipefail
cd "$(dirname "$0")/../../.."
for module in ${MODULES:-fusion files mask cues poses}; do
  config="tests/proofs/mutants/$module.toml" session="$module.sqlite"
  cosmic-ray init "$config" "$session"
  cr-filter-operators "$session" "$config"
  python tests/proofs/mutants/drop_skipped.py "$session"
  cosmic-ray baseline "$config"
  cosmic-ray exec "$config" "$session"
  cr-report --surviving-only --show-diff "$session"
  echo "$module, share of changes that survive:"
  cr-rate --fail-over 15 "$session" || weak="${weak:-} $module"
done
[ -z "${weak:-}" ] || { echo "more than 15 % survive in:$weak"; exit 1; }
