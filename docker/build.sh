#!/usr/bin/env bash
# Builds the image: wheels by the pip of this machine (so the build itself needs no network), then docker build.
#
#   docker/build.sh [--tag kantor] [further arguments of docker build, such as --build-arg BASE=...]
#
# PYTHON names a Python of the version that the base image has, 3.11. Beside compose.yaml it leaves runs/ and .env, which
# names the user of the containers: the owner of the identities and the runs, and never root.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}
tag=kantor
if [ "${1:-}" = --tag ]; then tag=$2; shift 2; fi

rm -rf docker/wheels.new
mkdir -p docker/wheels docker/wheels.new
"$python" -m pip wheel --quiet --disable-pip-version-check --constraint constraints.txt --wheel-dir docker/wheels.new \
    --find-links docker/wheels hatchling \
    $("$python" -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["dependencies"])')
rm -rf docker/wheels
mv docker/wheels.new docker/wheels

DOCKER_BUILDKIT=${DOCKER_BUILDKIT:-0} docker build --quiet --file docker/Dockerfile --tag "$tag" "$@" . >/dev/null

if [ "$(id -u)" = 0 ]; then owner=10001:10001; else owner=$(id -u):$(id -g); fi
mkdir -p docker/runs docker/keys
if [ "$(id -u)" = 0 ]; then chown "$owner" docker/runs docker/keys; fi
[ -e docker/.env ] || printf 'COMPOSE_PROJECT_NAME=kantor\nKANTOR_USER=%s\n' "$owner" >docker/.env
echo "$tag: built"
