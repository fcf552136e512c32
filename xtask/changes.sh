#!/bin/sh
# Prints what changed since the last tag, for the files of a release: the first section of CHANGELOG.md, then the commits.
set -eu
VERSION=$1
LAST=$(git describe --tags --abbrev=0 HEAD^ 2>/dev/null || true)
printf '# stable-worldmodel %s\n' "$VERSION"
# Links lead to pages of the repository, which are not beside this file.
awk '/^## / { sections++; next } sections == 1' CHANGELOG.md | sed 's/\[\([^]]*\)\]([^)]*\.md[^)]*)/\1/g'
printf '## Commits%s\n\n' "${LAST:+ since $LAST}"
git log --no-merges --format='- %s (%h)' ${LAST:+"$LAST.."}HEAD
