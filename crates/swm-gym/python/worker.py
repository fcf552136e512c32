"""The process around a `Bridge`: requests come in on a socket, what they bring goes into shared memory.

File descriptors at the start: 0 is the socket, 1 the shared memory (a file without a name), 2 a pipe whose last lines
the parent keeps. Before anything of the environment runs, 0 becomes /dev/null and 1 a copy of 2, so that nothing an
environment prints or reads can disturb the exchange.

A request is a byte that says which, the length of its payload (4 bytes, little-endian) and the payload; so is an
answer. The first request carries the sources of the other modules and what environment to make.
"""

import ctypes
import importlib.abc
import importlib.util
import json
import mmap
import os
import signal
import socket
import struct
import sys
import traceback

FRAME = struct.Struct('<BI')
# The kinds of answers: done; raised a Python error; no such id; a package is missing; refused in words, and with what to do.
DONE, RAISED, UNKNOWN, MISSING, REFUSED, WRONG = b'.xumfw'
PR_SET_PDEATHSIG = 1


def die_with(parent):
    """Ends this process when the parent ends, however it ends, and whatever this process is busy with."""
    if sys.platform == 'linux':
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


class Sources(importlib.abc.MetaPathFinder, importlib.abc.InspectLoader):
    """Imports modules that came as text, so that nothing has to be installed."""

    def __init__(self, texts):
        self.texts = texts

    def find_spec(self, name, path=None, target=None):
        return importlib.util.spec_from_loader(name, self) if name in self.texts else None

    def get_source(self, name):
        return self.texts[name]

    def get_code(self, name):
        return compile(self.texts[name], f'{name}.py', 'exec')


class Line:
    """The exchange with the parent."""

    def __init__(self, descriptor):
        self.socket = socket.socket(fileno=descriptor)

    def read(self, n):
        data = b''
        while len(data) < n:
            more = self.socket.recv(n - len(data))
            if not more:
                raise EOFError('the parent has closed the connection, or is gone')
            data += more
        return data

    def request(self):
        op, n = FRAME.unpack(self.read(FRAME.size))
        return op, self.read(n) if n else b''

    def answer(self, kind, text=''):
        data = text.encode('utf-8', 'replace')
        self.socket.sendall(FRAME.pack(kind, len(data)) + data)


def made(line, memory):
    """Makes what the first request wants and says what it is, or why it cannot be."""
    wanted = json.loads(line.request()[1])
    sys.meta_path.append(Sources(wanted['modules']))
    try:
        import gymnasium
        import swm_bridge
    except ModuleNotFoundError as error:
        return line.answer(MISSING, json.dumps({'asset': 'gymnasium', 'message': str(error)}))
    try:
        bridge = swm_bridge.make(wanted['id'], wanted['options'])
        description = bridge.describe()
        # Room that is not there is an error now, not a SIGBUS later.
        os.posix_fallocate(memory, 0, bridge.size)
        bridge.attach(mmap.mmap(memory, bridge.size))
        line.answer(DONE, description)
        return bridge
    except swm_bridge.Missing as error:
        asset, message = error.args
        line.answer(MISSING, json.dumps({'asset': asset, 'message': message}))
    except gymnasium.error.UnregisteredEnv:
        line.answer(UNKNOWN, json.dumps(sorted(gymnasium.registry)))
    except (swm_bridge.Unsupported, gymnasium.error.DependencyNotInstalled, gymnasium.error.DeprecatedEnv) as error:
        line.answer(REFUSED, str(error))
    except BaseException:
        line.answer(RAISED, traceback.format_exc())
    return None


def obey(line, bridge):
    """Does what is asked until the parent closes the line."""
    from swm_bridge import Wrong

    while True:
        op, payload = line.request()
        try:
            bridge.handle(op, payload)
        except Wrong as error:
            line.answer(WRONG, json.dumps(error.args))
        except BaseException:  # Even `sys.exit()` is an answer.
            line.answer(RAISED, traceback.format_exc())
        else:
            line.answer(DONE)


def serve():
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # The parent decides when to stop.
    die_with(int(sys.argv[1]))
    line, memory = Line(os.dup(0)), os.dup(1)
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    os.dup2(2, 1)
    bridge = None
    try:
        bridge = made(line, memory)
        if bridge is not None:
            obey(line, bridge)
    except (EOFError, ConnectionError):
        if bridge is not None:
            bridge.close()
    finally:
        # Not by the way of threads that an environment left behind.
        os._exit(0)


serve()
