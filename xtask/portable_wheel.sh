#!/bin/sh
# Links the Python extension against an old glibc and a small FFmpeg, and puts FFmpeg into the wheel: `make wheel-portable` calls this with
# the tools of its Python environment on the path, after `make wheel`, whose compiled libraries it uses.
set -eu
PORTABLE=$1
OUT=$2
PLATFORM=manylinux_$(echo "$GLIBC" | tr . _)_x86_64
ZIG=$(python -c 'import pathlib, ziglang; print(pathlib.Path(ziglang.__file__).with_name("zig"))')
sh xtask/portable_ffmpeg.sh "$PORTABLE" "$ZIG" "$GLIBC"

# The extension loads FFmpeg when it needs it; linked with it, auditwheel finds it and puts it into the wheel.
# cargo-zigbuild translates rustc's options for GNU's linker into those of zig.
mkdir -p "$PORTABLE/bin"
printf '#!/bin/sh\nexec cargo-zigbuild zig cc -- -g -target x86_64-linux-gnu.%s -L "%s" "$@"\n' "$GLIBC" "$PORTABLE/ffmpeg/lib" > "$PORTABLE/bin/linker"
chmod +x "$PORTABLE/bin/linker"
trap 'sh xtask/share.sh' EXIT
sh xtask/share.sh small
cp "$PORTABLE"/ffmpeg/licences/* python/stable_worldmodel/share/licences/
rm -rf "$OUT" "$PORTABLE/linked"
CARGO_ZIGBUILD_ZIG_PATH=$ZIG maturin build --release --manifest-path python/Cargo.toml --out "$PORTABLE/linked" --compatibility linux \
  --auditwheel skip --interpreter "$(command -v python)" -- -C linker="$PORTABLE/bin/linker" \
  -C link-arg=-Wl,--no-as-needed -C link-arg=-lavformat -C link-arg=-lswscale
LD_LIBRARY_PATH=$PORTABLE/ffmpeg/lib auditwheel repair --plat "$PLATFORM" --wheel-dir "$OUT" "$PORTABLE"/linked/*.whl
auditwheel show "$OUT"/*.whl
ls -l "$OUT"
