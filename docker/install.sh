#!/bin/sh
# Inside the first stage of the image: install.sh dependencies | kantor
set -eu
pip() { /pip/bin/python -m pip --python /opt/kantor/bin/python "$@"; }
if ls /wheels/*.whl >/dev/null 2>&1; then
    export PIP_NO_INDEX=1 PIP_FIND_LINKS=/wheels
fi

case $1 in
dependencies)
    /pip/bin/python -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["dependencies"], sep="\n")' >/requirements.txt
    pip install --quiet --no-compile --requirement /requirements.txt --constraint constraints.txt
    /pip/bin/python /wheels/lighten.py /opt/kantor/lib/python3*/site-packages
    ;;
kantor)
    PIP_CONSTRAINT=constraints.txt pip install --quiet --no-compile --no-deps .
    cd /opt/kantor/lib/python3*/site-packages
    # Without modules that only PDF output and tables of sweeps need.
    /opt/kantor/bin/python -m compileall -q -j 0 --invalidation-mode unchecked-hash -x '/(fontTools|pygments|scipy/(io|signal|stats))/' .
    /opt/kantor/bin/python -c 'from kantor_fleet.execution.preload import warm_up; warm_up()'
    chmod -R a+rX "$KANTOR_KERNELS"
    ;;
esac
