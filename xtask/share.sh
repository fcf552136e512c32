#!/bin/sh
# Fills `share` of the Python package, which the wheel and the source distribution contain: our licences, and the whole zoo. With the argument
# `small`, the zoo is the capsule of the guides and the experts; `data-wheel.txt` lists the others, so that the engine can say that the data
# wheel (`python/zoo`) has them.
set -eu
ZOO=python/stable_worldmodel/share/swm/zoo
rm -rf python/stable_worldmodel/share
mkdir -p "$ZOO" python/stable_worldmodel/share/licences
cp LICENSE-APACHE LICENSE-MIT python/stable_worldmodel/share/licences/
if [ "${1:-}" != small ]; then
  cp -r zoo/. "$ZOO"
  exit 0
fi
for capsule in $(cd zoo && find . -name '*.safetensors' | sed 's|^\./||' | LC_ALL=C sort); do
  case $capsule in
    two-room/pldm.safetensors | */expert.safetensors) install -D -m 644 "zoo/$capsule" "$ZOO/$capsule" ;;
    *) echo "${capsule%.safetensors}" >> "$ZOO/data-wheel.txt" ;;
  esac
done
