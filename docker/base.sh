#!/usr/bin/env bash
# A stand-in for the Dockerfile's base image, from Debian packages, where no image registry can be reached.
#
#   sudo docker/base.sh [--force]
#
# It has Debian's Python 3.11 and gets the name that the Dockerfile asks for (BASE names another). An image of that
# name that is not a stand-in is left alone, unless forced. MIRROR names another Debian mirror than debootstrap's own.
set -euo pipefail

base=${BASE:-python:3.11-slim-bookworm}
mark=kantor.stand-in

if [ "${1:-}" != --force ] && docker image inspect "$base" >/dev/null 2>&1; then
    if [ "$(docker image inspect --format "{{index .Config.Labels \"$mark\"}}" "$base")" = yes ]; then
        echo "$base: the stand-in is there already; --force makes it again"
        exit 0
    fi
    echo "base.sh: $base is a real image, use it as it is; --force puts the stand-in in its place" >&2
    exit 1
fi
command -v debootstrap >/dev/null || { echo "base.sh: needs debootstrap; apt-get install debootstrap" >&2; exit 1; }
[ "$(id -u)" = 0 ] || { echo "base.sh: debootstrap needs root; sudo docker/base.sh" >&2; exit 1; }

root=$(mktemp -d)
trap 'rm -rf --one-file-system "$root"' EXIT
debootstrap --variant=minbase --include=python3,python3-venv,ca-certificates bookworm "$root" ${MIRROR:+"$MIRROR"} >"$root.log" 2>&1 ||
    { tail -5 "$root.log" >&2; echo "base.sh: debootstrap failed; see $root.log" >&2; exit 1; }
rm "$root.log"
tar -C "$root" --numeric-owner \
    --exclude=./proc/* --exclude=./sys/* --exclude=./dev/* \
    --exclude=./var/cache/apt/* --exclude=./var/lib/apt/lists/* --exclude=./var/log/* \
    --exclude=./usr/share/doc/* --exclude=./usr/share/man/* --exclude=./usr/share/locale/* \
    -c . |
    docker import --change "LABEL $mark=yes" --change 'ENV LANG=C.UTF-8' --change 'CMD ["python3"]' - "$base" >/dev/null
echo "$base: made from Debian packages"
