"""Hostile scripts that exhaust resources or send false messages to the agent."""

EXHAUSTION = {
    "takes_all_memory": """
        rest = []
        try:
            while True: rest.append(bytearray(16 * 2**20))
        except MemoryError:
            if len(rest) > 40: breach(len(rest))""",
    "takes_memory_past_python": """
        libc.mmap.restype = c_void_p
        libc.mmap.argtypes = [c_void_p, ctypes.c_size_t, ctypes.c_int, ctypes.c_int, ctypes.c_int, c_long]
        if libc.mmap(None, 2**31, 3, 0x22, -1, 0) not in (None, 2**64 - 1): breach()""",
    "grows_its_stack": """
        sys.setrecursionlimit(10**9)
        def deeper(): return deeper()
        deeper()""",
    "computes_for_ever": "while True: pass",
    "computes_for_ever_inside_of_c": "x = 9 ** 9 ** 8",
    "sleeps_for_ever": "wait(10**6)",
    "ignores_every_signal": """
        import signal
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
    "asks_for_ever": """
        while True: robot.state()""",
    "says_progress_for_ever": """
        while True: progress(0.5)""",
    "leaves_a_time_bomb": """
        import signal
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
    "sends_garbage": """
        for _ in range(50): os.write(3, os.urandom(500) + b'\\n')""",
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
