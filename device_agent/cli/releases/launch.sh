#!/bin/sh
# Launcher of the Telescope agent: starts the release in use. `install-agent.sh` copies it to PREFIX/bin/telescope-agent.
#
# A new release is on trial until the agent has written a result to its folder. A release that failed, or that was
# started MAX_STARTS times without a result, is not started again: the release before it is. Updates do not replace this
# file, so a broken release cannot break it.
set -u
MAX_STARTS=3

prefix=$(dirname "$(dirname "$(readlink -f "$0")")")
home=${TELESCOPE_AGENT_HOME:-$(sed -n 's/^home=//p' "$prefix/installation")}
result=$home/release-trial
release=$prefix/current
export TELESCOPE_AGENT_HOME="$home"
unset TELESCOPE_TRIAL

say() { echo "telescope-agent: $*" >&2; }

# record STATE: write the state of the trial atomically, for this user only.
record() { (umask 077 && echo "$id $*" >"$result.new" && mv -f "$result.new" "$result") 2>/dev/null; }

use_previous() {
    say "$1; starting the release before it"
    release=$prefix/previous
}

runs=
for word in "$@"; do
    if [ "$word" = run ]; then runs=1; fi
done

if [ ! -x "$release/bin/telescope-agent" ]; then
    use_previous "release $(basename "$(readlink "$release")") is incomplete"
elif [ -n "$runs" ] && [ -f "$prefix/trial" ]; then
    read -r id version link timeout before <"$prefix/trial"
    found='' state=''
    if [ -f "$result" ]; then read -r found state rest <"$result"; fi
    if [ "$found" != "$id" ]; then state=0; fi
    if [ "$(readlink "$release")" = "releases/$version" ]; then
        case $state in
            passed) ;;
            failed) use_previous "release $version has failed" ;;
            [0-9])
                if [ "$state" -ge "$MAX_STARTS" ]; then
                    record "failed it ended $MAX_STARTS times before it was ready"
                    use_previous "release $version ended $MAX_STARTS times before it was ready"
                elif record "$((state + 1))"; then
                    export TELESCOPE_TRIAL="$id $link $timeout"
                else
                    use_previous "$home cannot be written, so release $version cannot be checked"
                fi
                ;;
            *) use_previous "$result is damaged" ;;
        esac
    fi
fi
if [ ! -x "$release/bin/telescope-agent" ]; then
    say "no release is installed in $prefix; run install-agent.sh again"
    exit 1
fi
exec "$release/bin/telescope-agent" "$@"
