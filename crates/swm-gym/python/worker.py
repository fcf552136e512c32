"""The worker process of a `Bridge`: requests arrive on a socket, outputs go into shared memory.

File descriptors at the start: 0 is the socket, 1 the shared memory (a file without a name), 2 a pipe to the parent.
Before any code of the environment runs, 0 becomes /dev/null and 1 a copy of 2, so that the environment's input and
output cannot disturb the protocol.

A request is one byte for its kind, the length of its payload (4 bytes, little-endian) and the payload; an answer has
the same form. The first request carries the sources of the other modules and the environment to make.
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
# Kinds of answers: done; an exception; an unknown id; a missing package; unsupported; an invalid request.
DONE, RAISED, UNKNOWN, MISSING, REFUSED, INVALID = b'.xumfw'
PR_SET_PDEATHSIG = 1


def die_with(parent):
    """Ends this process when the parent ends, however it ends."""
    if sys.platform == 'linux':
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


class Sources(importlib.abc.MetaPathFinder, importlib.abc.InspectLoader):
    """Imports modules from text, so that nothing has to be installed."""

    def __init__(self, texts):
        self.texts = texts

    def find_spec(self, name, path=None, target=None):
        return importlib.util.spec_from_loader(name, self) if name in self.texts else None

    def get_source(self, name):
        return self.texts[name]

    def get_code(self, name):
        return compile(self.texts[name], f'{name}.py', 'exec')


class Connection:
    """The connection to the parent."""

    def __init__(self, descriptor):
        self.socket = socket.socket(fileno=descriptor)

    def read(self, n):
        data = b''
        while len(data) < n:
            more = self.socket.recv(n - len(data))
            if not more:
                raise EOFError('the parent closed the connection or ended')
            data += more
        return data

    def request(self):
        op, n = FRAME.unpack(self.read(FRAME.size))
        return op, self.read(n) if n else b''

    def answer(self, kind, text=''):
        data = text.encode('utf-8', 'replace')
        self.socket.sendall(FRAME.pack(kind, len(data)) + data)


def make(connection, memory):
    """Makes the environment of the first request and answers with its description, or why it cannot be made."""
    request = json.loads(connection.request()[1])
    sys.meta_path.append(Sources(request['modules']))
    try:
        import gymnasium
        import swm_bridge
    except ModuleNotFoundError as error:
        return connection.answer(MISSING, json.dumps({'asset': 'gymnasium', 'message': str(error)}))
    try:
        bridge = swm_bridge.make(request['id'], request['options'])
        description = bridge.describe()
        # A lack of memory is an error now instead of a SIGBUS later.
        os.posix_fallocate(memory, 0, bridge.size)
        bridge.attach(mmap.mmap(memory, bridge.size))
        connection.answer(DONE, description)
        return bridge
    except swm_bridge.Missing as error:
        asset, message = error.args
        connection.answer(MISSING, json.dumps({'asset': asset, 'message': message}))
    except gymnasium.error.UnregisteredEnv:
        connection.answer(UNKNOWN, json.dumps(sorted(gymnasium.registry)))
    except (swm_bridge.Unsupported, gymnasium.error.DependencyNotInstalled, gymnasium.error.DeprecatedEnv) as error:
        connection.answer(REFUSED, str(error))
    except BaseException:
        connection.answer(RAISED, traceback.format_exc())
    return None


def handle_requests(connection, bridge):
    """Handles requests until the parent closes the connection."""
    from swm_bridge import InvalidRequest

    while True:
        op, payload = connection.request()
        try:
            bridge.handle(op, payload)
        except InvalidRequest as error:
            connection.answer(INVALID, json.dumps(error.args))
        except BaseException:  # Including `sys.exit()`.
            connection.answer(RAISED, traceback.format_exc())
        else:
            connection.answer(DONE)


def serve():
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # The parent decides when to stop.
    die_with(int(sys.argv[1]))
    connection, memory = Connection(os.dup(0)), os.dup(1)
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    os.dup2(2, 1)
    bridge = None
    try:
        bridge = make(connection, memory)
        if bridge is not None:
            handle_requests(connection, bridge)
    except (EOFError, ConnectionError):
        if bridge is not None:
            bridge.close()
    finally:
        # Without waiting for threads of the environment.
        os._exit(0)


serve()
