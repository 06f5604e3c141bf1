#!/usr/bin/env bash
# Trains one iteration in an image, as on a read-only root file system; fails where it does not train or writes elsewhere.
#
#   image.sh IMAGE
set -euo pipefail
image=$1
container=$(buildah from "$image")
trap 'buildah rm "$container" > /dev/null' EXIT

size="--set run.iterations=1 --set run.episodes=4 --set run.steps=50 --set run.evaluation_episodes=2"
# shellcheck disable=SC2086 # several words
buildah run --mount type=tmpfs,destination=/tmp --mount type=tmpfs,destination=/runs,tmpfs-mode=1777 \
    "$container" -- t6gps train flat-quick $size

# Its user owns nothing but the folder for runs. What it has written beside the two mounts would be its own.
written=$(buildah run --user root "$container" -- find / -xdev -user 1000 -not -path /runs)
if [ -n "$written" ]; then
    echo "it wrote outside of /tmp and /runs:" "$written" >&2
    exit 1
fi
buildah images --filter "reference=$image" --format '{{.Name}}:{{.Tag}} trains; {{.Size}}'
