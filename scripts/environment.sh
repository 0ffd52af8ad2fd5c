# Sourced by the other scripts: makes the project's own virtual environment, once, and again when its needs change.
# usage: environment EXTRA   ('' for users, 'dev' for checks and tests)
set -eu

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
venv="$root/.venv"

find_python() {
    for candidate in "${PYTHON:-}" python3.11 python3.12 python3.13 python3.14 python3; do
        if [ -n "$candidate" ] && "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
            command -v "$candidate"
            return
        fi
    done
    echo "crashhunt needs Python 3.11 or later; install it, or name one: PYTHON=/path/to/python3 $0" >&2
    return 2
}

environment() {
    extra=$1
    wanted=$(cat "$root/pyproject.toml" "$root/scripts/build_core.py" "$root"/crashhunt/native/{_build_id.py,_core.py,_link_order.py,*.?pp} \
        "$root"/crashhunt/highway/accelerator/{_kernel.py,*.?pp} "$root"/crashhunt/executors/{_native_stack.py,*.?pp} | cksum)
    # A development environment serves users too.
    for have in dev "$extra"; do
        if [ "$(cat "$venv/made-for-${have:-users}" 2>/dev/null)" = "$wanted" ]; then return; fi
    done
    python=$(find_python) || exit 2
    mkdir -p "$venv"
    exec 9>"$venv/lock"
    if command -v flock >/dev/null; then flock 9; fi # two first uses at once: the second waits
    if [ "$(cat "$venv/made-for-${extra:-users}" 2>/dev/null)" != "$wanted" ]; then
        echo "making the virtual environment $venv (once; about a minute) ..." >&2
        "$python" -m venv "$venv"
        "$venv/bin/python" -m pip install --quiet --disable-pip-version-check --editable "$root${extra:+[$extra]}" >&2
        if ! "$venv/bin/python" -c 'import _crashhunt_core' 2>/dev/null; then
            echo "crashhunt goes without its compiled core, which needs a C++ compiler and Python's headers:" \
                "steps on SUMO take longer, and results are the same" >&2
        fi
        if ! "$venv/bin/python" -c 'import importlib.util as u, sys; sys.exit(not u.find_spec("_crashhunt_link_order"))'; then
            echo "crashhunt goes without the fixed order of SUMO's links, which needs a C++ compiler:" \
                "trials on SUMO may differ between processes" >&2
        fi
        echo "$wanted" >"$venv/made-for-${extra:-users}"
    fi
    exec 9>&-
}
