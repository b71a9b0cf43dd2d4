#!/bin/sh
# Arranges the image content below a folder: the binary without debug information (symbols stay for backtraces) and the
# licences of its parts. Usage: deploy/container/stage.sh BINARY FOLDER
set -eu

binary=$1
stage=$2
root=$(CDPATH='' cd -- "$(dirname -- "$0")/../.." && pwd)
doc=$stage/usr/share/doc/molmesh

rm -rf "$stage"
mkdir -p "$stage/usr/local/bin" "$doc"
strip --strip-debug -o "$stage/usr/local/bin/molmesh" "$binary"
chmod 0755 "$stage/usr/local/bin/molmesh"
cp "$root/LICENSE-MIT" "$root/LICENSE-APACHE" "$doc/"
python3 "$root/deploy/notices.py" >"$doc/THIRD-PARTY.txt"
chmod 0644 "$doc"/*
