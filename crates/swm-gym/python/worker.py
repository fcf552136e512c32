"""The worker process of a `Bridge`: requests arrive on a socket, outputs go into shared memory.

File descriptors at the start: 0 is the socket, 1 the shared memory (an anonymous file), 2 a pipe to the parent.
Before any code of the environment runs, 0 becomes /dev/null and 1 becomes a copy of 2, so that reads and writes of the
environment do not reach the socket and the shared memory.

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

HEADER = struct.Struct('<BI')
# Kinds of answers: done; an exception; an unknown id; a missing package; unsupported; an invalid request.
DONE, RAISED, UNKNOWN, MISSING, UNSUPPORTED, INVALID = b'.xumfw'
PR_SET_PDEATHSIG = 1


def exit_with_parent(parent):
    """Makes this process end when the parent process ends in any way."""
    if sys.platform == 'linux':
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


class Sources(importlib.abc.MetaPathFinder, importlib.abc.InspectLoader):
    """Imports modules from source texts that the parent sends, so that they need not be installed."""

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
        self.process = os.getpid()
        # Otherwise a forked process would keep the connection open after its parent ends.
        os.register_at_fork(after_in_child=self.socket.close)

    def check_process(self):
        """Ends a process that the environment forked: only the worker itself talks to the parent."""
        if os.getpid() != self.process:
            print(f'process {os.getpid()}, forked by the environment, ended: it is not the worker', file=sys.stderr)
            os._exit(1)

    def read(self, n):
        data = b''
        while len(data) < n:
            chunk = self.socket.recv(n - len(data))
            if not chunk:
                raise EOFError('the parent closed the connection or ended')
            data += chunk
        return data

    def request(self):
        self.check_process()
        op, n = HEADER.unpack(self.read(HEADER.size))
        return op, self.read(n) if n else b''

    def answer(self, kind, text=''):
        self.check_process()
        data = text.encode('utf-8', 'replace')
        self.socket.sendall(HEADER.pack(kind, len(data)) + data)


def make(connection, memory):
    """Makes the environment of the first request and answers with its description, or with the reason for a failure."""
    request = json.loads(connection.request()[1])
    if ':' in request['id']:
        # The user named a module, which may be in the current folder. All other modules are found elsewhere first.
        sys.path.append(os.getcwd())
    sys.meta_path.append(Sources(request['modules']))
    try:
        import gymnasium
        import swm_bridge
    except ModuleNotFoundError as error:
        return connection.answer(MISSING, json.dumps({'asset': 'gymnasium', 'message': str(error)}))
    try:
        bridge = swm_bridge.make(request['id'], request['options'])
        description = bridge.describe()
        # Allocates the memory, so that a lack of memory raises an error here instead of a SIGBUS at a later write.
        os.posix_fallocate(memory, 0, bridge.size)
        bridge.attach(mmap.mmap(memory, bridge.size))
        connection.answer(DONE, description)
        return bridge
    except swm_bridge.Missing as error:
        asset, message = error.args
        connection.answer(MISSING, json.dumps({'asset': asset, 'message': message}))
    except gymnasium.error.UnregisteredEnv:
        connection.answer(UNKNOWN, json.dumps(sorted(gymnasium.registry)))
    except swm_bridge.Unsupported as error:
        connection.answer(INVALID, json.dumps([error.args[0], error.FIX]))
    except (gymnasium.error.DependencyNotInstalled, gymnasium.error.DeprecatedEnv) as error:
        connection.answer(UNSUPPORTED, str(error))
    except BaseException:
        connection.answer(RAISED, traceback.format_exc())
    return None


def handle_requests(connection, bridge):
    """Handles requests until the parent closes the connection. The text of an answer that a request is done is the warnings,
    one a line."""
    from swm_bridge import InvalidRequest

    noted = []
    bridge.warn = noted.append
    while True:
        op, payload = connection.request()
        try:
            noted.clear()
            bridge.handle(op, payload)
        except InvalidRequest as error:
            connection.answer(INVALID, json.dumps(error.args))
        except BaseException:  # Including `sys.exit()`.
            connection.answer(RAISED, traceback.format_exc())
        else:
            connection.answer(DONE, '\n'.join(noted))


def serve():
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # The parent handles SIGINT and closes the connection.
    exit_with_parent(int(sys.argv[1]))
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
        # `os._exit` does not wait for threads of the environment.
        os._exit(0)


serve()
