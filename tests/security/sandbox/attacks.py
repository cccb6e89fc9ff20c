"""Hostile scripts. Each reports a success with ``breach(…)``; the attack host also checks from outside.

``call(name, …)`` makes a system call by number, without Python or libc wrappers.
``worked(result)`` reports a breach if the call succeeded.
"""

from textwrap import dedent

PRELUDE = """
import ctypes, os, signal, socket, sys
from ctypes import byref, c_char_p, c_long, c_uint64, c_void_p, create_string_buffer
P = parameters
libc = ctypes.CDLL(None, use_errno=True)
libc.syscall.restype = c_long
libc.mmap.restype = c_void_p
libc.mmap.argtypes = [c_void_p, ctypes.c_size_t, ctypes.c_int, ctypes.c_int, ctypes.c_int, c_long]
def call(name, *arguments):
    kinds = {int: c_long, bytes: c_char_p}
    given = [kinds.get(type(each), lambda known: known)(each) for each in arguments]
    return libc.syscall(c_long(P["numbers"][name]), *given)
def breach(what=""): print("BREACH", what, flush=True)
def worked(result):
    if result >= 0: breach(result)
def tries(what, *arguments):
    try:
        result = what(*arguments)
    except OSError: return None
    breach(result)
    return result
buffer = create_string_buffer(64)
def transfer():
    parts = [(c_uint64 * 2)(each, 64) for each in (ctypes.addressof(buffer), P["secret_address"])]
    return P["agent"], byref(parts[0]), 1, byref(parts[1]), 1, 0
def map_memory(size, rights): return libc.mmap(None, size, rights, 0x22, -1, 0)
AT_FDCWD = -100
NOT_MAPPED = (None, 2**64 - 1)
print("TRIED", flush=True)
# ---- the attack
"""

FILES = {
    "reads_the_agents_key": "tries(lambda: open(P['key']).read())",
    "reads_the_agents_key_by_system_call": "worked(call('openat', AT_FDCWD, P['key'].encode(), 0, 0))",
    "reads_the_agents_key_by_openat2": """
        how = (c_uint64 * 3)(0, 0, 0)
        worked(call('openat2', AT_FDCWD, P['key'].encode(), byref(how), 24))""",
    "reads_the_agents_key_by_a_path_descriptor": "worked(call('openat', AT_FDCWD, P['home'].encode(), 0o10200000, 0))",
    "reads_the_passwords": "tries(lambda: open('/etc/passwd').read())",
    "reads_the_shadow_passwords": "worked(call('openat', AT_FDCWD, b'/etc/shadow', 0, 0))",
    "reads_the_agents_environment": """
        tries(lambda: open(f"/proc/{P['agent']}/environ").read())
        if any('SECRET' in value for value in os.environ.values()): breach('environment')""",
    "reads_its_own_environment_file": "tries(lambda: open('/proc/self/environ').read())",
    "reads_the_agents_memory": "worked(call('openat', AT_FDCWD, b'/proc/%d/mem' % P['agent'], 0, 0))",
    "writes_its_own_memory_by_a_file": "worked(call('openat', AT_FDCWD, b'/proc/self/mem', 2, 0))",
    "lists_the_agents_folder": "tries(os.listdir, P['home'])",
    "asks_whether_a_file_is_there": "tries(os.stat, P['key'])",
    "asks_whether_a_file_may_be_read": "worked(call('faccessat', AT_FDCWD, P['key'].encode(), 4, 0))",
    "reads_where_a_link_goes": "tries(os.readlink, '/proc/self/exe')",
    "writes_beside_the_agents_key": "tries(lambda: open(P['home'] + '/new', 'w').write('x'))",
    "writes_over_the_agents_key": "tries(lambda: open(P['key'], 'w').write('x'))",
    "writes_to_the_temporary_folder": "tries(lambda: open(P['outside'], 'w').write('x'))",
    "writes_to_shared_memory_files": "worked(call('openat', AT_FDCWD, b'/dev/shm/telescope-attack', 0o102, 0o600))",
    "makes_a_file_without_a_name": "worked(call('openat', AT_FDCWD, b'/tmp', 0o20200002, 0o600))",
    "makes_a_symbolic_link": "tries(os.symlink, P['key'], P['outside'])",
    "makes_a_hard_link": "tries(os.link, P['key'], P['outside'])",
    "deletes_the_agents_key": "tries(os.unlink, P['key'])",
    "renames_the_agents_key": "tries(os.rename, P['key'], P['outside'])",
    "cuts_the_agents_key": "tries(os.truncate, P['key'], 0)",
    "makes_the_agents_key_readable": "tries(os.chmod, P['key'], 0o666)",
    "makes_a_folder": "tries(os.mkdir, P['outside'])",
    "makes_a_pipe_with_a_name": "tries(os.mkfifo, P['outside'])",
    "makes_a_device_node": "worked(call('mknodat', AT_FDCWD, P['outside'].encode(), 0o20666, 0x101))",
    "changes_its_folder": "tries(os.chdir, P['home'])",
    "fills_the_disk": """
        with open(P['outside'], 'wb') as file:
            for _ in range(100):
                file.write(bytes(2**20))
        breach()""",
    "watches_files": """
        watch = call('inotify_init1', 0)
        worked(watch)
        worked(call('fanotify_init', 0, 0))""",
    "opens_a_file_by_its_handle": """
        handle = create_string_buffer(128)
        handle[0] = 100
        worked(call('name_to_handle_at', AT_FDCWD, P['key'].encode(), handle, byref(ctypes.c_int()), 0))
        worked(call('open_by_handle_at', AT_FDCWD, handle, 0))""",
    "opens_the_machines_memory": "worked(call('openat', AT_FDCWD, b'/dev/mem', 2, 0))",
    "opens_the_terminal": "worked(call('openat', AT_FDCWD, b'/dev/tty', 2, 0))",
}

NETWORK = {
    "connects_by_tcp": "tries(lambda: socket.socket().connect(('127.0.0.1', P['port'])))",
    "listens_by_tcp": """
        link = socket.socket()
        tries(link.bind, ('127.0.0.1', 0))
        tries(link.listen)""",
    "sends_by_udp": "tries(lambda: socket.socket(type=socket.SOCK_DGRAM).sendto(b'x', ('127.0.0.1', P['port'])))",
    "connects_to_a_socket_file": "tries(lambda: socket.socket(socket.AF_UNIX).connect(P['home'] + '/socket'))",
    "connects_to_an_abstract_socket": """
        tries(lambda: socket.socket(socket.AF_UNIX).connect(b'\\0' + P['abstract'].encode()))""",
    "listens_to_all_packets": "worked(call('socket', 17, 3, 0x300))",
    "talks_to_the_kernel_by_netlink": "worked(call('socket', 16, 3, 0))",
    "makes_a_socket_pair": "worked(call('socketpair', 1, 1, 0, (ctypes.c_int * 2)()))",
    "makes_a_pipe": "worked(call('pipe2', (ctypes.c_int * 2)(), 0))",
    "connects_its_only_socket_elsewhere": """
        address = (2).to_bytes(2, sys.byteorder) + P['port'].to_bytes(2, 'big') + bytes([127, 0, 0, 1]) + bytes(8)
        worked(call('connect', 3, address, 16))""",
}

PROCESSES = {
    "forks": "tries(os.fork)",
    "forks_until_nothing_is_left": """
        for _ in range(10000):
            if tries(os.fork) is None: break""",
    "forks_by_vfork": "worked(call('vfork'))",
    "forks_by_clone": "worked(call('clone', 17, 0, 0, 0, 0))",
    "forks_by_clone3": "worked(call('clone3', (c_uint64 * 11)(), 88))",
    "starts_a_thread": """
        import threading
        try:
            thread = threading.Thread(target=breach, args=('thread',))
            thread.start()
            thread.join()
        except RuntimeError:
            pass""",
    "starts_a_thread_by_libc": """
        pthread = c_uint64()
        body = ctypes.CFUNCTYPE(c_void_p, c_void_p)(lambda _: breach() or 0) if False else libc.sleep
        if libc.pthread_create(byref(pthread), None, body, None) == 0: breach()""",
    "becomes_a_shell": "tries(os.execv, '/bin/sh', ['sh', '-c', 'echo > ' + P['outside']])",
    "runs_a_shell": "os.system('echo > ' + P['outside'])",
    "spawns_a_program": "tries(os.posix_spawn, '/bin/sh', ['sh', '-c', 'echo > ' + P['outside']], {})",
    "runs_a_program_from_memory": """
        file = call('memfd_create', b'x', 0)
        worked(file)
        call('execveat', file, b'', 0, 0, 0x1000)""",
    "kills_the_agent": "tries(os.kill, P['agent'], 9)",
    "kills_a_process_of_the_agents_user": "tries(os.kill, P['victim'], 9)",
    "stops_a_process_of_the_agents_user": "tries(os.kill, P['victim'], 19)",
    "kills_everything": "worked(call('kill', -1, 9))",
    "kills_the_warm_parent": """
        worked(call('kill', 0, 9))
        for pid in P['parents']: tries(os.kill, pid, 9)""",
    "kills_a_thread_of_the_agent": "worked(call('tgkill', P['agent'], P['agent'], 9))",
    "queues_a_signal": "worked(call('rt_sigqueueinfo', P['victim'], 9, create_string_buffer(128)))",
    "signals_by_descriptor": """
        process = call('pidfd_open', P['victim'], 0)
        worked(process)
        worked(call('pidfd_send_signal', process, 9, 0, 0))""",
    "makes_its_socket_signal_the_agent": """
        worked(call('fcntl', 3, 8, P['victim']))
        worked(call('fcntl', 3, 4, 0o20000))""",
    "traces_a_process": "worked(call('ptrace', 16, P['victim'], 0, 0))",
    "seizes_the_agent": "worked(call('ptrace', 0x4206, P['agent'], 0, 0))",
    "reads_the_agents_memory_by_system_call": "worked(call('process_vm_readv', *transfer()))",
    "writes_the_agents_memory_by_system_call": "worked(call('process_vm_writev', *transfer()))",
    "takes_a_descriptor_of_the_agent": """
        process = call('pidfd_open', P['agent'], 0)
        worked(call('pidfd_getfd', process, 0, 0))""",
    "compares_itself_with_the_agent": "worked(call('kcmp', P['agent'], P['agent'], 0, 0, 0))",
    "asks_for_real_time": "worked(call('sched_setscheduler', 0, 1, byref(ctypes.c_int(50))))",
    "slows_the_agent_down": "worked(call('setpriority', 0, P['agent'], 19))",
    "becomes_more_important": "worked(call('setpriority', 0, 0, -20))",
    "takes_the_agents_memory_limit": "worked(call('prlimit64', P['agent'], 7, byref((c_uint64 * 2)(3, 3)), 0))",
    "leaves_its_session": "worked(call('setsid'))",
    "joins_the_agents_group": "worked(call('setpgid', 0, P['agent']))",
}

PRIVILEGES = {
    "becomes_root": """
        worked(call('setuid', 0))
        worked(call('setresuid', 0, 0, 0))""",
    "becomes_another_user": "worked(call('setresuid', 1000, 1000, 1000))",
    "joins_groups": "worked(call('setgroups', 1, byref(ctypes.c_int(0))))",
    "takes_back_capabilities": """
        header, all_of_them = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)(*[0xffffffff] * 6)
        worked(call('capset', header, all_of_them))""",
    "becomes_root_of_a_new_user_namespace": "worked(call('unshare', 0x10000000))",
    "leaves_its_mounts": "worked(call('unshare', 0x20000))",
    "enters_the_agents_namespace": "worked(call('setns', 3, 0))",
    "mounts": "worked(call('mount', b'none', b'/tmp', b'tmpfs', 0, 0))",
    "mounts_the_new_way": "worked(call('fsopen', b'tmpfs', 0))",
    "unmounts": "worked(call('umount2', b'/proc', 2))",
    "changes_its_root": "worked(call('chroot', b'/tmp'))",
    "changes_the_root_of_all_processes": "worked(call('pivot_root', b'/tmp', b'/tmp'))",
    "allows_itself_new_privileges": "worked(call('prctl', 38, 0, 0, 0, 0))",
    "survives_its_parent": "worked(call('prctl', 1, 0, 0, 0, 0))",
    "lets_others_look_into_it": "worked(call('prctl', 4, 1, 0, 0, 0))",
    "switches_seccomp_off": """
        worked(call('prctl', 22, 0, 0, 0, 0))
        worked(call('seccomp', 0, 0, 0))""",
    "puts_a_filter_of_its_own": "worked(call('seccomp', 1, 0, create_string_buffer(16)))",
    "raises_its_limits": """
        import resource
        tries(resource.setrlimit, resource.RLIMIT_NOFILE, (1000, 1000))
        worked(call('prlimit64', 0, 1, byref((c_uint64 * 2)(2**62, 2**62)), 0))""",
    "changes_its_personality": "worked(call('personality', 0x0040000))",
    "makes_another_landlock": "worked(call('landlock_create_ruleset', byref((c_uint64 * 3)(1, 0, 0)), 24, 0))",
}

KERNEL = {
    "loads_a_bpf_program": "worked(call('bpf', 5, create_string_buffer(128), 128))",
    "measures_the_machine": "worked(call('perf_event_open', create_string_buffer(128), 0, -1, -1, 0))",
    "handles_page_faults": "worked(call('userfaultfd', 1))",
    "makes_an_io_uring": "worked(call('io_uring_setup', 8, create_string_buffer(256)))",
    "reads_keys": "worked(call('keyctl', 0, -3, 1, 0, 0))",
    "adds_keys": "worked(call('add_key', b'user', b'x', b'y', 1, -3))",
    "makes_a_memory_file": "worked(call('memfd_create', b'x', 0))",
    "loads_a_module": "worked(call('init_module', b'', 0, b''))",
    "loads_a_kernel": "worked(call('kexec_load', 0, 0, 0, 0))",
    "restarts_the_machine": "call('reboot', 0, 0, 0, 0)",
    "renames_the_machine": "worked(call('sethostname', b'attacked', 8))",
    "sets_the_clock": "worked(call('settimeofday', (c_uint64 * 2)(1, 1), 0))",
    "adjusts_the_clock": "worked(call('adjtimex', create_string_buffer(256)))",
    "reads_the_kernels_log": "worked(call('syslog', 3, create_string_buffer(64), 64))",
    "shares_memory_the_old_way": "worked(call('shmget', 0x7e1e, 4096, 0o1666))",
    "shares_messages_the_old_way": "worked(call('msgget', 0x7e1e, 0o1666))",
    "opens_a_message_queue": "worked(call('mq_open', b'telescope', 0o102, 0o600, 0))",
    "types_into_the_terminal": "worked(call('ioctl', 0, 0x5412, b'x'))",
    "asks_how_the_machine_is_called": "tries(os.uname)",
    "asks_how_much_memory_there_is": "worked(call('sysinfo', create_string_buffer(256)))",
    "swaps": "worked(call('swapoff', b'/dev/zero'))",
    "locks_memory": "worked(call('mlockall', 3))",
    "makes_an_event_descriptor": """
        worked(call('eventfd2', 0, 0))
        worked(call('timerfd_create', 0, 0))
        worked(call('epoll_create1', 0))
        worked(call('signalfd4', -1, create_string_buffer(8), 8, 0))""",
}

DESCRIPTORS = {
    "finds_a_descriptor_of_the_agent": """
        for number in (*range(4, 2000), 2**16, 2**20 - 1):
            worked(call('read', number, create_string_buffer(1), 0))
            worked(call('write', number, b'', 0))""",
    "doubles_its_socket": """
        tries(os.dup, 3)
        worked(call('fcntl', 3, 0, 10))""",
    "sends_a_descriptor_to_the_agent": "worked(call('sendmsg', 3, create_string_buffer(56), 0))",
    "receives_a_descriptor": "worked(call('recvmsg', 3, create_string_buffer(56), 0x40))",
    "opens_its_socket_again": "tries(lambda: open('/proc/self/fd/3', 'rb'))",
    "asks_who_is_at_the_other_end": """
        worked(call('getsockopt', 3, 1, 17, create_string_buffer(12), byref(ctypes.c_int(12))))
        worked(call('getpeername', 3, create_string_buffer(110), byref(ctypes.c_int(110))))""",
    "maps_its_socket": "worked(call('mmap', 0, 4096, 1, 2, 3, 0) if call('mmap', 0, 4096, 1, 2, 3, 0) > 0 else -1)",
}

CODE = {
    "runs_machine_code_of_its_own": """
        if map_memory(4096, 7) not in NOT_MAPPED: breach('written and run')
        place = map_memory(4096, 3)
        worked(call('mprotect', c_void_p(place), 4096, 5))""",
    "calls_the_kernel_as_a_32_bit_program": """
        if P['machine'] != 'x86_64': raise SystemExit
        # mov eax, 20 (getpid); int 0x80; ret: in memory that an earlier mapping of libffi may have left open to run.
        place = map_memory(4096, 7)
        if place in NOT_MAPPED: raise SystemExit
        code = bytes.fromhex('b814000000cd80c3')
        ctypes.memmove(place, code, len(code))
        if ctypes.CFUNCTYPE(c_long)(place)() > 0: breach()""",
    "calls_the_kernel_by_x32_numbers": """
        if P['machine'] != 'x86_64': raise SystemExit
        result = libc.syscall(c_long(0x40000000 + 39))
        if result > 0: breach(result)""",
    "finds_a_way_in_python_itself": """
        for kind in object.__subclasses__():
            if kind.__name__ == 'Popen':
                tries(kind, ['/bin/sh', '-c', 'echo > ' + P['outside']])
        loader = [k for k in object.__subclasses__() if k.__name__ == 'BuiltinImporter'][0]
        posix = loader.load_module('posix')
        tries(posix.open, P['key'], 0)""",
    "unpickles_a_command": """
        import pickle
        tries(pickle.loads, b"cposix\\nopen\\n(V" + P['key'].encode() + b"\\nI0\\ntR.")""",
    "looks_for_secrets_in_what_it_inherited": """
        import gc
        needle = ''.join(reversed(P['secret_reversed']))
        texts = [e for e in gc.get_objects() if isinstance(e, (dict, list, tuple)) and e is not globals()]
        for each in texts:
            values = each.values() if isinstance(each, dict) else each
            for value in values:
                if isinstance(value, (str, bytes)) and value in (needle, needle.encode()): breach('memory')""",
    "loads_a_library": "tries(ctypes.CDLL, 'libutil.so.1')",
    "leaves_a_surprise_for_the_next_script": """
        import builtins, json
        builtins.print_before = print
        json.dumps = lambda *a, **k: '{"kind": "ended"}'
        sys.modules['math'] = None
        os.environ['SURPRISE'] = '1'""",
}

EXHAUSTION = {
    "takes_all_memory": """
        rest = []
        try:
            while True: rest.append(bytearray(16 * 2**20))
        except MemoryError:
            if len(rest) > 40: breach(len(rest))""",
    "takes_memory_past_python": "if map_memory(2**31, 3) not in NOT_MAPPED: breach()",
    "grows_its_stack": """
        sys.setrecursionlimit(10**9)
        def deeper(): return deeper()
        deeper()""",
    "computes_for_ever": "while True: pass",
    "computes_for_ever_inside_of_c": "x = 9 ** 9 ** 8",
    "sleeps_for_ever": "wait(10**6)",
    "ignores_every_signal": """
        for number in range(1, 65):
            try: signal.signal(number, signal.SIG_IGN)
            except (OSError, ValueError): pass
        signal.pthread_sigmask(signal.SIG_BLOCK, range(1, 65))
        while True: pass""",
    "never_reads_its_answers": """
        line = b'{"kind": "state"}\\n'
        while True: os.write(3, line)""",
    "prints_for_ever": "while True: print('x' * 1000)",
    "prints_one_endless_line": "while True: os.write(3, b'x' * 65536)",
    "asks_for_ever": "while True: robot.state()",
    "says_progress_for_ever": "while True: progress(0.5)",
    "leaves_a_time_bomb": """
        signal.signal(signal.SIGALRM, lambda *_: breach('later'))
        signal.alarm(1)
        signal.setitimer(signal.ITIMER_REAL, 0.2)""",
}

LIES = {
    "moves_without_the_api": """
        for speed in ('0.5', '1e9', 'NaN', '1e999', '-1'):
            os.write(3, b'{"kind": "move_joints", "position_rad": {"elbow": 1}, "speed": %s}\\n' % speed.encode())
        for value in ('NaN', 'Infinity', '1e999', 'null', '"1"', 'true'):
            os.write(3, b'{"kind": "move_joints", "position_rad": {"elbow": %s}, "speed": 0.5}\\n' % value.encode())""",
    "moves_after_it_has_ended": """
        os.write(3, b'{"kind": "ended", "error": ""}\\n')
        os.write(3, b'{"kind": "home", "speed": 0.123}\\n' * 50)
        while True: pass""",
    "says_progress_that_is_none": """
        for share in ('NaN', '-1', '2', '1e999', '"1"', '[]'):
            os.write(3, b'{"kind": "progress", "share": %s}\\n' % share.encode())""",
    "sends_nested_json": "os.write(3, b'[' * 60000 + b'\\n')",
    "sends_garbage": "for _ in range(50): os.write(3, os.urandom(500) + b'\\n')",
    "sends_a_number_of_endless_digits": """
        os.write(3, b'{"kind": "progress", "share": 0.' + b'1' * 60000 + b'}\\n')""",
    "sends_names_of_other_kinds": """
        for kind in ('ready', 'unfit', '__class__', 'stop', 'reset_stop', 'grant_lease'):
            os.write(3, b'{"kind": "%s"}\\n' % kind.encode())""",
    "claims_that_the_sandbox_is_broken": 'os.write(3, b\'{"kind": "unfit", "reason": "x"}\\n\')',
    "ends_without_a_word": "os._exit(0)",
    "closes_its_socket": """
        os.close(3)
        while True: pass""",
}

GROUPS = (FILES, NETWORK, PROCESSES, PRIVILEGES, KERNEL, DESCRIPTORS, CODE, EXHAUSTION, LIES)
ATTACKS = {name: PRELUDE + dedent(source) for group in GROUPS for name, source in group.items()}
