#!/bin/sh
# Builds the FFmpeg of the portable wheel in a folder, once: `make wheel-portable` calls this. Only parts under the LGPL and the BSD licence:
# H.264 is encoded by OpenH264 and lossless video as FFV1, AV1 is decoded by dav1d. The sources are Debian's packages of this machine's
# release; the compiler is zig's, because it links against an old glibc.
set -eu
WORK=$1
ZIG=$2
GLIBC=$3
PREFIX=$WORK/ffmpeg
[ -e "$PREFIX/ready" ] && exit 0
rm -rf "$WORK/sources" "$WORK/build" "$WORK/bin" "$PREFIX"
mkdir -p "$WORK/sources/apt/parts" "$WORK/sources/apt/lists/partial" "$WORK/build" "$WORK/bin" "$PREFIX/licences"

# The machine's own sources of packages, with source packages, without changing its settings.
for file in /etc/apt/sources.list.d/debian*.sources; do
  [ ! -e "$file" ] || sed 's/^Types:.*/Types: deb-src/' "$file" > "$WORK/sources/apt/parts/$(basename "$file")"
done
[ ! -e /etc/apt/sources.list ] || sed -n 's/^deb /deb-src /p' /etc/apt/sources.list > "$WORK/sources/apt/parts/main.list"
cd "$WORK/sources"
set -- -o Dir::Etc::SourceList=/dev/null -o Dir::Etc::SourceParts="$PWD/apt/parts" -o Dir::State::Lists="$PWD/apt/lists" -qq
apt-get "$@" update
apt-get "$@" source ffmpeg openh264 dav1d
rm -- *.orig.tar.* *.debian.tar.*

for tool in cc:cc cxx:c++ ar:ar ranlib:ranlib; do
  target=
  case $tool in c*) target="-target x86_64-linux-gnu.$GLIBC -O2 -fno-sanitize=undefined" ;; esac
  printf '#!/bin/sh\nexec "%s" %s %s "$@"\n' "$ZIG" "${tool##*:}" "$target" > "$WORK/bin/${tool%%:*}"
  chmod +x "$WORK/bin/${tool%%:*}"
done
CC=$WORK/bin/cc CXX=$WORK/bin/cxx AR=$WORK/bin/ar
export CC CXX AR PKG_CONFIG_PATH="$PREFIX/lib/pkgconfig" PKG_CONFIG_LIBDIR="$PREFIX/lib/pkgconfig"

make -C "$WORK"/sources/openh264-*/ -j2 --silent OS=linux ARCH=x86_64 CC="$CC" CXX="$CXX" AR="$AR" PREFIX="$PREFIX" install-static
meson setup --prefix="$PREFIX" --libdir=lib --buildtype=release --default-library=static -Denable_tools=false -Denable_tests=false \
  "$WORK/build/dav1d" "$WORK"/sources/dav1d-*/
ninja -C "$WORK/build/dav1d" -j2 install

# What `swm-video` uses: decoders of MP4 files, encoders, one muxer, conversion of rare pixel formats.
mkdir "$WORK/build/ffmpeg"
cd "$WORK/build/ffmpeg"
"$WORK"/sources/ffmpeg-*/configure --prefix="$PREFIX" --cc="$CC" --cxx="$CXX" --ar="$AR" --ranlib="$WORK/bin/ranlib" \
  --enable-shared --disable-static --disable-programs --disable-doc --disable-debug --disable-autodetect --disable-network \
  --disable-everything --disable-avdevice --disable-avfilter --disable-swresample --disable-postproc --pkg-config-flags=--static \
  --enable-libopenh264 --enable-libdav1d --enable-decoder=h264,hevc,vp9,libdav1d,ffv1 --enable-encoder=libopenh264,ffv1 --enable-muxer=mp4,mov
# zig's headers of glibc lack <sys/sysctl.h>, which only other systems need.
sed -i 's/^#define HAVE_SYSCTL 1/#define HAVE_SYSCTL 0/' config.h
make -j2 --silent
make --silent install
cp "$WORK"/sources/ffmpeg-*/COPYING.LGPLv2.1 "$PREFIX/licences/"
cp "$WORK"/sources/openh264-*/LICENSE "$PREFIX/licences/openh264"
cp "$WORK"/sources/dav1d-*/COPYING "$PREFIX/licences/dav1d"
rm -r "$WORK/sources" "$WORK/build"
touch "$PREFIX/ready"
