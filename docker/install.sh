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
    cd /opt/kantor/lib/python3*/site-packages
    # What no kantor command opens: tests, sources and headers of compiled parts, stubs.
    find . -type d \( -name tests -o -name test -o -name testing -prune -o -name sample_data \) -prune -print >/tests.txt
    grep -vE '/(numpy|matplotlib|numba)/testing' /tests.txt | xargs rm -rf
    find . \( -name '*.pyi' -o -name '*.pxd' -o -name '*.pyx' -o -name '*.c' -o -name '*.cpp' -o -name '*.h' -o -name '*.hpp' -o -name '*.a' \) -delete
    if command -v strip >/dev/null; then strip --strip-unneeded llvmlite/binding/*.so; fi
    ;;
kantor)
    PIP_CONSTRAINT=constraints.txt pip install --quiet --no-compile --no-deps .
    cd /opt/kantor/lib/python3*/site-packages
    /opt/kantor/bin/python -m compileall -q -j 0 --invalidation-mode unchecked-hash .
    /opt/kantor/bin/python -c 'from kantor_fleet.preload import warm_up; warm_up()'
    ;;
esac
