"""Environments for the tests, which make them by ids of the form `tests.it.environments:NAME`."""

import os
import signal
import sys
import time

import gymnasium
import numpy as np
from gymnasium import spaces


class Factor(spaces.Box):
    """A leaf of a variation space: a box with a value."""

    def __init__(self, low, high, shape, init_value, dtype=np.float32):
        super().__init__(low, high, shape, dtype)
        self.init_value = self.value = np.asarray(init_value, dtype)

    def draw(self):
        self.value = self.sample()

    def set_value(self, value):
        assert self.contains(value), value
        self.value = value


class IntegerFactor(spaces.Discrete):
    """A leaf of a variation space: an integer with a range and a value."""

    def __init__(self, n, init_value):
        super().__init__(n)
        self.init_value = self.value = init_value

    def draw(self):
        self.value = int(self.sample())

    def set_value(self, value):
        assert self.contains(value), value
        self.value = value


class Group(spaces.Dict):
    """A group of factors, or all factors."""

    def leaves(self, prefix=''):
        for key, space in self.spaces.items():
            if isinstance(space, Group):
                yield from space.leaves(f'{prefix}{key}.')
            else:
                yield f'{prefix}{key}', space

    def start(self, seed, options):
        self.seed(seed)
        leaves = dict(self.leaves())
        varied = options.get('variation', ['agent.size'])
        for key, leaf in leaves.items():
            leaf.value = leaf.init_value
            if 'all' in varied or key in varied or key.split('.')[0] in varied:
                leaf.draw()
        for key, value in options.get('variation_values', {}).items():
            leaves[key].set_value(value)


class Room(gymnasium.Env):
    """A point in a room, with every feature of environments that the bridge supports.

    The room prints text and reads standard input; workers use the descriptors of both for shared memory and requests.
    """

    metadata = {'render_modes': ['rgb_array']}

    def __init__(self, render_mode=None, die_at=None, marker=None, raise_at=None, hang_at=None, size=4, meet=None):
        self.render_mode = render_mode
        self.failures = die_at, marker, raise_at, hang_at
        self.size, self.meet = size, meet
        self.action_space = spaces.Box(-0.4, 0.4, (2,), np.float64)
        self.observation_space = spaces.Dict({
            'position': spaces.Box(-np.inf, np.inf, (2,), np.float64),
            'camera': spaces.Box(0, 255, (6, 8, 3), np.uint8),
            'door': spaces.Dict({'open': spaces.Discrete(3), 'flags': spaces.MultiBinary(2)}),
            'reward': spaces.Discrete(5, start=2),
            'word': spaces.Text(4),
        })
        self.variation_space = Group({
            'agent': Group({
                'size': Factor(0.5, 2.0, (1,), [1.0]),
                'color': Factor(0, 255, (3,), [255, 0, 10], np.uint8),
            }),
            'door': Group({'number': IntegerFactor(4, 1)}),
        })

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.variation_space.start(seed, options or {})
        print('a new episode')
        # The bridge resets the environment once with seed 0 to describe it. At that time no other environment waits.
        self.meets = self.meet and seed
        if self.meets:
            self.wait_for_another('reset-')
        sys.stdin.read()
        self.t, self.position = 0, self.np_random.uniform(-1, 1, 2)
        goal = np.full((5, 7, 3), 40, np.uint8)
        goal[..., 1] = int(255 * self.np_random.uniform())
        return self.observation(), {'goal': goal, 'noise': 0.5, 'env_name': 'room', '_private': 3.0}

    def observation(self):
        camera = np.zeros((6, 8, 3), np.uint8)
        camera[..., 0] = self.t
        camera[2, 3] = self.variation_space['agent']['color'].value
        door = {'open': self.t % 3, 'flags': np.array([self.t % 2, 1], np.int8)}
        return {'position': self.position, 'camera': camera, 'door': door, 'reward': 2 + self.t % 5, 'word': 'abc'}

    def step(self, action):
        assert self.action_space.contains(action), f'{action!r} is outside'
        die_at, marker, raise_at, hang_at = self.failures
        self.t += 1
        print('step', self.t)
        if self.meets:
            self.wait_for_another(f'step-{self.t}-')
        if self.t == raise_at:
            raise ValueError('the room is on fire')
        if self.t == hang_at:
            print('about to hang', file=sys.stderr, flush=True)
            while True:
                time.sleep(0.01)
        if self.t == die_at and not (marker and os.path.exists(marker)):
            if marker:
                open(marker, 'w').close()
            print('about to die', file=sys.stderr, flush=True)
            os.kill(os.getpid(), signal.SIGKILL)
        self.position = self.position + action * self.variation_space['agent']['size'].value
        distance = float(np.abs(self.position).sum())
        info = {'steps': self.t, 'moved': np.float32(np.abs(action).sum()), 'goal_distance': distance}
        if self.t % 2:
            info['noise'] = self.np_random.uniform()
        info['success'] = self.t >= 6
        return self.observation(), -1.5, self.t >= 7, False, info

    def wait_for_another(self, what):
        """Waits until two rooms have reached this call."""
        open(os.path.join(self.meet, f'{what}{os.getpid()}'), 'w').close()
        for _ in range(1000):
            if sum(name.startswith(what) for name in os.listdir(self.meet)) == 2:
                return
            time.sleep(0.01)
        raise TimeoutError('no other room reached this call')

    def render(self):
        frame = np.zeros((self.size * 3, self.size * 4, 3), np.uint8)
        frame[: self.size, ..., 2] = 20 * self.t
        return frame


class Field(gymnasium.Env):
    """A point that moves to a goal in a wind that depends on the seed. Methods set its position and goal."""

    metadata = {'render_modes': ['rgb_array']}

    def __init__(self, render_mode=None):
        self.render_mode = render_mode
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.variation_space = Group({'agent': Group({'size': Factor(0.5, 2.0, (1,), [1.0])})})
        self.t = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.variation_space.start(seed, options or {})
        self.t = 0
        self.wind = self.np_random.uniform(-0.1, 0.1, 2)
        self.position, self.goal = self.np_random.uniform(-1, 1, (2, 2))
        return self.position, self.info()

    def info(self):
        state = np.concatenate([self.position, [self.t]])
        return {'state': state, 'goal_state': np.append(self.goal, 0.0), 'wind': self.wind, 'set': getattr(self, 'how', 0)}

    def _set_state(self, state):
        assert isinstance(state, np.ndarray) and state.dtype == np.float64, state
        state += 0  # Fails if the array is read-only.
        self.position, self.t, self.how = state[:2].copy(), int(state[2]), 1

    def _set_goal_state(self, goal_state):
        self.goal = goal_state[:2]

    def place(self, x, y=0.0, label=''):
        self.position, self.how = np.array([x, y]), len(label)

    def step(self, action):
        self.t += 1
        self.position = self.position + action * self.variation_space['agent']['size'].value + self.wind
        info = self.info()
        info.pop('goal_state')
        return self.position, 0.0, bool(np.abs(self.position - self.goal).max() < 0.1), False, info

    def render(self):
        frame = np.zeros((16, 16, 3), np.uint8)
        x, y = np.clip((self.position + 2) * 4, 0, 15).astype(int)
        frame[y, x] = 255
        return frame


class Jointed(Field):
    """An environment whose `set_state` has two arguments, which no single column provides."""

    _set_state = None

    def set_state(self, qpos, qvel):
        raise AssertionError('no column has these arguments')


class Declared(Jointed):
    """An environment whose `swm_callables` names the method that sets its state."""

    swm_callables = [{'method': 'place', 'args': {'x': {'value': 'x'}, 'label': {'value': 'ab', 'in_dataset': False}}}]


class Choices(gymnasium.Env):
    """An environment that observes only its last action and does not render."""

    SPACES = {
        'discrete': spaces.Discrete(3, start=-1),
        'multi': spaces.MultiDiscrete([2, 3]),
        'binary': spaces.MultiBinary(3),
        'integer_box': spaces.Box(0, 2, (2, 2), np.int32),
        'tuple': spaces.Tuple([spaces.Discrete(2), spaces.MultiDiscrete([3, 4])]),
        'dict': spaces.Dict({'a': spaces.Box(-1, 1, (2,)), 'b': spaces.Box(0, np.inf, (1,))}),
        'mixed': spaces.Dict({'a': spaces.Box(-1, 1, (2,)), 'b': spaces.Discrete(2)}),
    }

    def __init__(self, kind):
        self.action_space = self.SPACES[kind]
        n = spaces.flatdim(spaces.Dict({'all': self.action_space})) + 8
        self.observation_space = spaces.Box(-np.inf, np.inf, (n,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(self.observation_space.shape, np.float32), {}

    def step(self, action):
        assert self.action_space.contains(action), f'{action!r} is outside {self.action_space}'
        values = []
        for part in action.values() if isinstance(action, dict) else action if isinstance(action, tuple) else [action]:
            values.extend(np.asarray(part, np.float32).reshape(-1))
        observation = np.zeros(self.observation_space.shape, np.float32)
        observation[: len(values)] = values
        return observation, 0.0, False, False, {}


class Coated(gymnasium.Wrapper):
    """A wrapper that adds factors, and rendering in every render mode, to an environment without them."""

    def __init__(self):
        super().__init__(Choices('discrete'))
        self.variation_space = Group({'coat': Factor(0, 255, (3,), [9, 9, 9], np.uint8)})

    def reset(self, *, seed=None, options=None):
        self.variation_space.start(seed, options or {})
        return self.env.reset(seed=seed)

    def render(self):
        return np.broadcast_to(self.variation_space['coat'].value, (2, 2, 3))


class Counter(gymnasium.Env):
    """Observes the number of its steps. `fault` happens in step 2."""

    action_space = spaces.Discrete(2)
    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)

    def __init__(self, fault=None):
        self.fault, self.t = fault, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.float32([0]), {}

    def step(self, action):
        self.t += 1
        # The bridge takes one step to describe the environment.
        fault = getattr(self, self.fault) if self.fault and self.t == 2 else None
        if fault is not None:
            fault()
        return np.float32([self.t]), 0.0, False, False, {}

    def fork(self):
        os.fork()

    def fork_and_raise(self):
        if os.fork() == 0:
            raise ValueError('an exception in a child process')

    def fork_and_end(self):
        if os.fork():
            os._exit(3)

    def close_descriptors(self):
        os.closerange(3, 64)

    def exec(self):
        os.execlp('sleep', 'sleep', '100')

    def answer(self, head=b'.\xff\xff\xff\xff'):
        """Writes bytes to every socket, as a process that violates the protocol."""
        for descriptor in range(3, 64):
            try:
                if os.readlink(f'/proc/self/fd/{descriptor}').startswith('socket:'):
                    os.write(descriptor, head)
            except OSError:
                pass

    def shrink(self):
        """Shrinks every file that is neither a socket nor a pipe: the memory that is shared with the engine."""
        for descriptor in range(3, 64):
            try:
                os.ftruncate(descriptor, 0)
            except OSError as error:
                print(f'shrinking {descriptor}: {error}', file=sys.stderr)

    def answer_unknown(self):
        self.answer(b'\x00\x05\x00\x00\x00abc\xff\xfe')


class Wide(gymnasium.Env):
    """Observes an integer, and from step 2 one of `VALUES`, which its column cannot hold."""

    action_space = spaces.Discrete(2)
    observation_space = spaces.Box(0, np.iinfo(np.uint64).max, (1,), np.uint64)
    VALUES = {'large': np.uint64([2**63 + 5]), 'fraction': np.float64([1.5]), 'nan': np.float64([np.nan])}

    def __init__(self, value):
        self.value, self.t = self.VALUES[value], 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.uint64([2**62]), {}

    def step(self, action):
        self.t += 1
        return self.value if self.t == 2 else np.float64([self.t]), 0.0, False, False, {}


class Loose(gymnasium.Env):
    """Declares three numbers, and returns something else at step 2."""

    action_space = spaces.Discrete(2)
    observation_space = spaces.Box(-9, 9, (3,), np.float32)
    VALUES = {
        'scalar': np.float32(7),
        'one': np.float32([7]),
        'column': np.float32([[1], [2], [3]]),
        'complex': np.array([1 + 5j, 2, 3]),
        'text': np.array(['1', '2', '3']),
        'row': np.float32([[1, 2, 3]]),
    }

    def __init__(self, value):
        self.value, self.t = value, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(3, np.float32), {'success': False}

    def step(self, action):
        self.t += 1
        observation = self.VALUES.get(self.value, np.zeros(3, np.float32)) if self.t == 2 else np.zeros(3, np.float32)
        if self.t != 2:
            return observation, 0.0, False, False, {'success': False}
        successes = {'success': 'no', 'nan': float('nan'), 'success-list': (False, False), 'success-nan': [float('nan')]}
        successes |= {'success-minus': -1, 'success-part': 0.01, 'success-two': 2}
        successes |= {'one-false': [False], 'one-true': np.array([1]), 'numpy': np.bool_(True), 'success-gone': None}
        if self.value == 'is-success':
            return observation, 0.0, False, False, {'is_success': (True, True)}
        success = successes.get(self.value, False)
        ends = {'end-nan': float('nan'), 'end-text': 'False', 'end-none': None, 'end-minus': -1}
        ends |= {'missing': True, 'success-gone': True}
        rewards = {'reward': '1', 'reward-none': None, 'reward-pair': np.zeros(2), 'reward-one': np.ones(1)}
        reward = rewards.get(self.value, 0.0)
        info = {} if self.value == 'missing' else {'success': success}
        return observation, reward, ends.get(self.value, False), False, info


gymnasium.register('Loose-v0', Loose, max_episode_steps=1_000_000)
gymnasium.register('Wide-v0', Wide, max_episode_steps=1_000_000)
gymnasium.register('Counter-v0', Counter, max_episode_steps=1_000_000)
gymnasium.register('Room-v0', Room, max_episode_steps=30)
gymnasium.register('Coated-v0', Coated)
gymnasium.register('Field-v0', Field, max_episode_steps=20)
gymnasium.register('Choices-v0', Choices)
gymnasium.register('Jointed-v0', Jointed)
gymnasium.register('Declared-v0', Declared)
