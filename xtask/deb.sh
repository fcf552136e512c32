#!/bin/sh
# Packs a folder of a release (the program, zoo, completions, manual pages) as a Debian package: `xtask/release.sh` calls this. Written with
# dpkg-deb, because cargo-deb would compile the program again, without the list of dependencies inside it.
set -eu
FOLDER=$1
OUT=$2
VERSION=$3
NAME=stable-worldmodel
ARCH=$(dpkg --print-architecture)
WORK=$(mktemp -d)
trap 'rm -r "$WORK"' EXIT
ROOT=$WORK/root
DOC=$ROOT/usr/share/doc/$NAME

install -D -m 755 "$FOLDER/swm" "$ROOT/usr/bin/swm"
install -D -m 644 "$FOLDER/swm.bash" "$ROOT/usr/share/bash-completion/completions/swm"
install -D -m 644 "$FOLDER/swm.zsh" "$ROOT/usr/share/zsh/vendor-completions/_swm"
install -D -m 644 "$FOLDER/swm.fish" "$ROOT/usr/share/fish/vendor_completions.d/swm.fish"
for page in "$FOLDER"/man/*.1; do install -D -m 644 "$page" "$ROOT/usr/share/man/man1/$(basename "$page")"; done
for file in $(cd "$FOLDER" && find share -type f); do install -D -m 644 "$FOLDER/$file" "$ROOT/usr/$file"; done
install -D -m 644 "$FOLDER/README.md" "$DOC/README.md"
{
  echo 'Format: https://www.debian.org/doc/packaging-manuals/copyright-format/1.0/'
  echo "Upstream-Name: $NAME"
  printf '\nFiles: *\nCopyright: The stable-worldmodel developers\nLicense: Expat or Apache-2.0\n'
  printf '\nLicense: Expat\n'
  sed -e 's/[[:space:]]*$//' -e 's/^$/./' -e 's/^/ /' "$FOLDER/LICENSE-MIT"
  printf '\nLicense: Apache-2.0\n On Debian systems, the text is in /usr/share/common-licenses/Apache-2.0.\n'
} > "$DOC/copyright"
# Packages have a changelog of their own form, with short lines. The text is that of the release.
install -m 644 "$FOLDER/CHANGES.md" "$DOC/CHANGES.md"
{
  printf '%s (%s) unstable; urgency=medium\n\n' "$NAME" "$VERSION"
  printf '  * Release %s: CHANGES.md.gz in this folder lists what changed.\n' "$VERSION"
  printf '\n -- The stable-worldmodel developers <noreply@example.org>  %s\n' "$(date --utc --rfc-email --date="@$SOURCE_DATE_EPOCH")"
} > "$DOC/changelog"
gzip -9 --no-name "$DOC/changelog" "$DOC/CHANGES.md" "$ROOT"/usr/share/man/man1/*.1

# The libraries that the program is linked with, as packages of this release of Debian, and FFmpeg's, which it loads when it needs them.
mkdir -p "$WORK/debian" "$ROOT/DEBIAN"
printf 'Source: %s\n\nPackage: %s\nArchitecture: %s\n' "$NAME" "$NAME" "$ARCH" > "$WORK/debian/control"
echo 'int main(void) { return 0; }' | cc -x c - -o "$WORK/ffmpeg" -Wl,--no-as-needed -lavformat -lavcodec -lavutil -lswscale
DEPENDS=$(cd "$WORK" && dpkg-shlibdeps -O root/usr/bin/swm ffmpeg | sed -n 's/^shlibs:Depends=//p')
cat > "$ROOT/DEBIAN/control" <<EOF
Package: $NAME
Version: $VERSION
Architecture: $ARCH
Maintainer: The stable-worldmodel developers <noreply@example.org>
Installed-Size: $(du -sk --apparent-size "$ROOT" | cut -f1)
Depends: $DEPENDS
Recommends: ffmpeg
Suggests: python3
Section: science
Priority: optional
Description: world models: collect, train, plan, evaluate
 Collects trajectories from environments with controllable factors of
 variation, trains latent world models, plans with them, and measures control
 and generalisation. This package contains the program swm and small models.
EOF
(cd "$ROOT" && find usr -type f -print0 | sort -z | xargs -0 md5sum > DEBIAN/md5sums)
find "$ROOT" -exec touch --no-dereference --date="@$SOURCE_DATE_EPOCH" {} +
dpkg-deb --root-owner-group -Zxz -z6 --threads-max=2 --build "$ROOT" "$OUT/${NAME}_${VERSION}_$ARCH.deb"
