#!/bin/bash
# start.sh RUN: the entry point of a RayJob. It puts the job's folder on the claim, then trains as every job does.
#
# /job holds what was submitted, /runs is the root, /tmp/t6gps.pid says whom SIGTERM stops cleanly. A retry finds the
# run that it goes on with. Who stops the run stops the Ray job, so that KubeRay neither calls it failed nor retries it.
set -eu
folder=/runs/.jobs/$1
mkdir -p "$folder" || {
    echo "error: the claim cannot be written by user $(id -u); see k8s.claim in the file of targets" >&2
    exit 2
}
cp -L /job/config.toml /job/train.sh "$folder/"
rm -f "$folder/publish" # of an earlier job
[ ! -e /job/publish ] || cp -L /job/publish "$folder/"
for ground in /job/ground.*; do
    if [ -e "$ground" ]; then
        mkdir -p "$folder/ground"
        cp -L "$ground" "$folder/ground/"
    fi
done

bash "$folder/train.sh" "$folder" >> "$folder/log" 2>&1 &
train=$!
echo "$train" > /tmp/t6gps.pid
tail --lines=0 --follow --retry --pid="$train" "$folder/log" 2> /dev/null & # for those who read Ray's own log
trap 'kill -TERM "$train" 2> /dev/null' TERM

code=0
wait "$train" || code=$?
while kill -0 "$train" 2> /dev/null; do # a signal has ended the wait, not the run
    code=0
    wait "$train" || code=$?
done
rm -f /tmp/t6gps.pid
wait
if [ "$code" = 130 ]; then
    trap 'exit 130' TERM
    ray job stop --no-wait --address http://127.0.0.1:8265 t6gps > /dev/null
    sleep 60 &
    wait
fi
exit "$code"
