#!/bin/sh
# Installs the Telescope agent as releases side by side, or prepares a further release. See --help.
set -eu

DEFAULT_PREFIX=/opt/telescope-agent
DEFAULT_HOME=/var/lib/telescope-agent
UNIT=telescope-agent.service
NEEDED_KB=1000000

usage() {
    cat <<'TEXT'
usage: install-agent.sh [options]

Installs the Telescope agent. An interrupted installation is repeated by the same command. If another release is
installed already, the command updates it, which waits until no device moves.

  --prefix DIR     where to install (default: /opt/telescope-agent, which needs root)
  --home DIR       folder of the agent's identity and journal
                   (default: /var/lib/telescope-agent as root, else ~/.telescope-agent)
  --user NAME      user of the service, created if necessary (root only; default: telescope-agent)
  --version V      version from PyPI (default: the newest)
  --sha256 HASH    expected hash of the wheel of telescope-agent from PyPI
  --bundle FILE    offline bundle: an archive of `make agent-bundle`, or its folder
  --python PROGRAM Python 3.11 or newer, with the module venv
  --no-service     do not write a systemd unit
  --dry-run        check everything and show what would be done
  --uninstall      remove all releases and the unit; the home folder stays
  --help           show this text
TEXT
}

say() { echo "install-agent: $*" >&2; }
fail() {
    say "$*"
    exit 1
}

PREFIX='' AGENT_HOME='' AGENT_USER='' VERSION='' SHA256='' BUNDLE='' PYTHON=''
SERVICE=1 DRY_RUN='' UNINSTALL='' PREPARE=''

parse() {
    while [ $# -gt 0 ]; do
        case $1 in
            --prefix | --home | --user | --version | --sha256 | --bundle | --python)
                [ $# -ge 2 ] || fail "$1 needs a value"
                case $1 in
                    --prefix) PREFIX=$2 ;;
                    --home) AGENT_HOME=$2 ;;
                    --user) AGENT_USER=$2 ;;
                    --version) VERSION=$2 ;;
                    --sha256) SHA256=$2 ;;
                    --bundle) BUNDLE=$2 ;;
                    --python) PYTHON=$2 ;;
                esac
                shift
                ;;
            --no-service) SERVICE='' ;;
            --dry-run) DRY_RUN=1 ;;
            --uninstall) UNINSTALL=1 ;;
            --prepare) PREPARE=1 ;; # for `telescope-agent update`: install a release, and change nothing else
            --help)
                usage
                exit 0
                ;;
            *) fail "unknown option $1; see --help" ;;
        esac
        shift
    done
    PREFIX=${PREFIX:-$DEFAULT_PREFIX}
    case $PREFIX in /*) ;; *) PREFIX=$(pwd)/$PREFIX ;; esac
    if [ -z "$VERSION" ] || [ -z "$BUNDLE" ]; then return; fi
    fail "--version and --bundle exclude each other"
}

is_root() { [ "$(id -u)" -eq 0 ]; }

# writable FOLDER: whether this user can create it, or write to it.
writable() {
    folder=$1
    while [ ! -e "$folder" ]; do folder=$(dirname "$folder"); done
    [ -w "$folder" ]
}

find_python() {
    for candidate in ${PYTHON:-python3.13 python3.12 python3.11 python3}; do
        command -v "$candidate" >/dev/null 2>&1 || continue
        "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || continue
        "$candidate" -c 'import venv, ensurepip' 2>/dev/null || {
            incomplete=$candidate
            continue
        }
        # Outside virtual environments, so that the release does not depend on one.
        PYTHON=$("$candidate" -c 'import os, sys; print(os.path.realpath(getattr(sys, "_base_executable", sys.executable)))')
        return
    done
    [ -z "${incomplete-}" ] || fail "$incomplete has no module venv; install it (Debian: apt-get install python3-venv)"
    fail "Python 3.11 or newer is missing; install it, or name it with --python"
}

check_machine() {
    is_root || writable "$PREFIX" || fail "$PREFIX cannot be written: run as root, or choose a folder with --prefix"
    find_python
    folder=$PREFIX
    while [ ! -e "$folder" ]; do folder=$(dirname "$folder"); done
    free=$(df -Pk "$folder" | awk 'NR == 2 { print $4 }')
    [ "$free" -ge "$NEEDED_KB" ] || fail "$folder has $((free / 1024)) MB left, and $((NEEDED_KB / 1024)) MB are needed"
}

# open_bundle: sets SOURCE to the verified folder of the bundle, and VERSION.
open_bundle() {
    [ -e "$BUNDLE" ] || fail "$BUNDLE does not exist"
    SOURCE=$BUNDLE
    if [ ! -d "$BUNDLE" ]; then
        "$PYTHON" - "$BUNDLE" "$WORK" <<'CODE' || fail "$BUNDLE is not an offline bundle, or is damaged"
import sys, tarfile
try:
    with tarfile.open(sys.argv[1]) as archive:
        members = [member for member in archive if member.isfile()]
        for member in members:
            if member.name.startswith("/") or ".." in member.name.split("/"):
                sys.exit(1)
        archive.extractall(sys.argv[2], members)
except (OSError, EOFError, tarfile.TarError):
    sys.exit(1)
CODE
        SOURCE=$(dirname "$(find "$WORK" -name SHA256SUMS | head -n 1)")
    fi
    [ -f "$SOURCE/SHA256SUMS" ] || fail "$BUNDLE is not an offline bundle: SHA256SUMS is missing"
    "$PYTHON" - "$SOURCE" <<'CODE' || fail "$BUNDLE is damaged; copy it again"
import hashlib, pathlib, sys
root = pathlib.Path(sys.argv[1])
listed = dict(reversed(line.split("  ", 1)) for line in (root / "SHA256SUMS").read_text().splitlines())
present = {str(p.relative_to(root)) for p in root.rglob("*") if p.is_file()} - {"SHA256SUMS"}
for name in sorted(present ^ set(listed)):
    print(f"install-agent: {name} is missing or not listed in SHA256SUMS", file=sys.stderr)
for name in sorted(present & set(listed)):
    if hashlib.sha256((root / name).read_bytes()).hexdigest() != listed[name]:
        print(f"install-agent: {name} differs from SHA256SUMS", file=sys.stderr)
        present.discard(name)
sys.exit(present != set(listed))
CODE
    VERSION=$(sed -n 's/^version=//p' "$SOURCE/BUNDLE")
    wanted=$(sed -n 's/^machine=//p' "$SOURCE/BUNDLE")/$(sed -n 's/^python=//p' "$SOURCE/BUNDLE")
    actual=$("$PYTHON" -c 'import platform, sys; print(f"{platform.machine()}/{sys.version_info[0]}.{sys.version_info[1]}")')
    [ "$wanted" = "$actual" ] ||
        fail "this bundle is for $wanted (machine/Python), and this machine has $actual; build a bundle for it"
    if grep -q '^compiles=.' "$SOURCE/BUNDLE" && ! command -v c++ >/dev/null 2>&1; then
        fail "this bundle contains source code ($(sed -n 's/^compiles=//p' "$SOURCE/BUNDLE")); install a C++ compiler" \
            "(Debian: apt-get install g++ make)"
    fi
}

# open_index: downloads the wheel of the agent, which contains the hashes of all other packages.
open_index() {
    SOURCE=$WORK
    mkdir -p "$WORK/wheels"
    "$PYTHON" -m venv "$WORK/pip"
    "$WORK/pip/bin/python" -m pip download --quiet --disable-pip-version-check --no-deps --only-binary :all: \
        --dest "$WORK/wheels" "telescope-agent${VERSION:+==$VERSION}" ||
        fail "telescope-agent ${VERSION} cannot be downloaded; check the network, or use --bundle"
    VERSION=$("$PYTHON" - "$WORK" "$SHA256" <<'CODE'
import hashlib, pathlib, sys, zipfile
root = pathlib.Path(sys.argv[1])
(wheel,) = (root / "wheels").glob("telescope_agent-*.whl")
digest = hashlib.sha256(wheel.read_bytes()).hexdigest()
if sys.argv[2] and sys.argv[2].lower() != digest:
    sys.exit(f"install-agent: the hash of {wheel.name} is {digest}, not the expected one; nothing was installed")
version = wheel.name.split("-")[1]
with zipfile.ZipFile(wheel) as archive:
    pins = archive.read("device_agent/requirements.txt").decode()
(root / "requirements.txt").write_text(f"{pins}telescope-agent=={version} --hash=sha256:{digest}\n")
print(version)
CODE
    ) || fail "the wheel of telescope-agent was rejected"
}

# install_release: installs VERSION from SOURCE. `.complete` is written last.
install_release() {
    target=$PREFIX/releases/$VERSION
    if [ -f "$target/.complete" ]; then
        say "release $VERSION is installed already"
        return
    fi
    say "installing release $VERSION"
    rm -rf "$target"
    mkdir -p "$PREFIX/releases"
    "$PYTHON" -m venv "$target" || fail "the virtual environment cannot be created"
    set -- --quiet --disable-pip-version-check --no-input --no-deps --require-hashes
    if [ -n "$BUNDLE" ]; then set -- "$@" --no-index; fi
    "$target/bin/python" -m pip install "$@" --find-links "$SOURCE/wheels" -r "$SOURCE/requirements.txt" ||
        fail "the packages of release $VERSION cannot be installed; the reason is above"
    "$target/bin/telescope-agent" --version >/dev/null || fail "release $VERSION does not start on this machine"
    sync
    : >"$target/.complete"
}

# link NAME RELEASE: replaces a link atomically.
link() {
    rm -f "$PREFIX/.$1.new"
    ln -s "releases/$2" "$PREFIX/.$1.new"
    "$PYTHON" -c 'import os, sys; os.replace(sys.argv[1], sys.argv[2])' "$PREFIX/.$1.new" "$PREFIX/$1"
}

write_settings() {
    umask 022
    mkdir -p "$PREFIX/bin" "$PREFIX/releases"
    printf 'home=%s\nuser=%s\n' "$AGENT_HOME" "$AGENT_USER" >"$PREFIX/.installation.new"
    mv -f "$PREFIX/.installation.new" "$PREFIX/installation"
}

write_launcher() {
    "$PREFIX/current/bin/python" -c 'import importlib.resources as r, sys
sys.stdout.write((r.files("device_agent.cli.releases") / "launch.sh").read_text(encoding="utf-8"))' >"$PREFIX/bin/.new"
    chmod 755 "$PREFIX/bin/.new"
    mv -f "$PREFIX/bin/.new" "$PREFIX/bin/telescope-agent"
}

create_user() {
    if ! is_root || [ -z "$AGENT_USER" ]; then
        mkdir -p -m 0700 "$AGENT_HOME"
        return
    fi
    id "$AGENT_USER" >/dev/null 2>&1 ||
        useradd --system --user-group --home-dir "$AGENT_HOME" --shell /usr/sbin/nologin "$AGENT_USER" ||
        fail "the user $AGENT_USER cannot be created"
    if [ ! -d "$AGENT_HOME" ]; then
        install -d -m 0700 -o "$AGENT_USER" -g "$(id -gn "$AGENT_USER")" "$AGENT_HOME"
    fi
}

unit_folder() { if is_root; then echo /etc/systemd/system; else echo "$HOME/.config/systemd/user"; fi; }

write_unit() {
    [ -n "$SERVICE" ] || return 0
    if ! command -v systemctl >/dev/null 2>&1; then
        say "systemd is missing, so no unit was written; start $PREFIX/bin/telescope-agent run, and again when it ends"
        return 0
    fi
    folder=$(unit_folder)
    mkdir -p "$folder"
    "$PREFIX/bin/telescope-agent" service-unit --prefix "$PREFIX" >"$folder/.$UNIT.new"
    mv -f "$folder/.$UNIT.new" "$folder/$UNIT"
    if is_root; then scope=''; else scope=--user; fi
    # shellcheck disable=SC2086 # empty for the system's manager
    systemctl $scope daemon-reload 2>/dev/null || say "run \`systemctl $scope daemon-reload\`"
    say "wrote $folder/$UNIT; after the enrollment: systemctl $scope enable --now telescope-agent"
}

uninstall() {
    [ -f "$PREFIX/installation" ] || fail "$PREFIX contains no agent"
    AGENT_HOME=$(sed -n 's/^home=//p' "$PREFIX/installation")
    state=$("$PREFIX/bin/telescope-agent" release 2>/dev/null || true) # empty if the installation is incomplete
    if [ -n "$state" ] && ! echo "$state" | grep -q '^running *no$'; then
        fail "the agent runs; stop its service first (systemctl disable --now telescope-agent)"
    fi
    if [ -n "$DRY_RUN" ]; then
        say "would remove $PREFIX and $(unit_folder)/$UNIT; $AGENT_HOME stays"
        return
    fi
    if [ -n "$SERVICE" ]; then rm -f "$(unit_folder)/$UNIT"; fi
    rm -rf "$PREFIX"
    say "removed $PREFIX; the identity and journal of the agent stay in $AGENT_HOME"
}

open_source() { if [ -n "$BUNDLE" ]; then open_bundle; else open_index; fi; }

main() {
    parse "$@"
    umask 022
    if [ -n "$UNINSTALL" ]; then
        uninstall
        return
    fi
    check_machine
    WORK=$(mktemp -d)
    trap 'rm -rf "$WORK"' EXIT
    trap 'exit 130' INT TERM
    open_source
    if [ -n "$PREPARE" ]; then
        install_release >&2
        echo "prepared $VERSION"
        return
    fi
    current=$(readlink "$PREFIX/current" 2>/dev/null || true)
    if [ -n "$current" ] && [ "$current" != "releases/$VERSION" ]; then
        [ -z "$DRY_RUN" ] || { say "would update $current to releases/$VERSION"; return; }
        say "updating ${current#releases/} to $VERSION"
        if [ -n "$BUNDLE" ]; then set -- --bundle "$BUNDLE"; else set -- --version "$VERSION"; fi
        "$PREFIX/bin/telescope-agent" update "$@"
        return
    fi
    if [ -f "$PREFIX/installation" ]; then
        AGENT_HOME=${AGENT_HOME:-$(sed -n 's/^home=//p' "$PREFIX/installation")}
        AGENT_USER=${AGENT_USER:-$(sed -n 's/^user=//p' "$PREFIX/installation")}
    elif is_root; then
        AGENT_HOME=${AGENT_HOME:-$DEFAULT_HOME} AGENT_USER=${AGENT_USER:-telescope-agent}
    else
        AGENT_HOME=${AGENT_HOME:-$HOME/.telescope-agent} AGENT_USER=''
    fi
    case $AGENT_HOME in /*) ;; *) AGENT_HOME=$(pwd)/$AGENT_HOME ;; esac
    if [ -n "$DRY_RUN" ]; then
        say "would install release $VERSION in $PREFIX with $PYTHON; home $AGENT_HOME, user ${AGENT_USER:-$(id -un)}"
        return
    fi
    write_settings
    install_release
    link current "$VERSION"
    write_launcher
    create_user
    write_unit
    say "installed $("$PREFIX/bin/telescope-agent" --version)"
    say "next: ${AGENT_USER:+setpriv --reuid=$AGENT_USER --regid=$AGENT_USER --clear-groups }$PREFIX/bin/telescope-agent enroll --server URL --device NAME=TYPE"
}

main "$@"
