#!/bin/bash
# train.sh FOLDER: trains the run of a job, from its start or from where it was. FOLDER is ROOT/.jobs/RUN.
#
# SIGTERM stops the run cleanly. FOLDER/exit_code says at last how it ended: 0 done, 130 stopped, 2 an error.
# The program t6gps is that of PATH. A script of Slurm sources this file when Ray is up.
folder=$1
root=${folder%/.jobs/*}
rm -f "$folder/exit_code"
unset T6GPS_SERVER # the run is trained here

publish=()
[ ! -e "$folder/publish" ] || publish=(--publish "$(< "$folder/publish")")

t6gps train "$folder/config.toml" --run "${folder##*/}" --root "$root" --resume ${publish[@]+"${publish[@]}"} < /dev/null &
train=$!
trap 'kill -TERM "$train"' TERM

code=0
wait "$train" || code=$?
while kill -0 "$train" 2> /dev/null; do # a signal has ended the wait, not the run
    code=0
    wait "$train" || code=$?
done
[ "$code" = 143 ] && code=130 # stopped before it could say so itself

echo "$code" > "$folder/.exit_code.$$"
mv "$folder/.exit_code.$$" "$folder/exit_code"
exit "$code"
