"""Proximal policy optimisation as single-file implementations write it, over vector environments."""

import gymnasium
import pytest

import stable_worldmodel as swm  # noqa: F401

torch = pytest.importorskip("torch")
torch.set_num_threads(1)

ENVS, STEPS, UPDATES = 4, 128, 24


def network(outputs):
    layers = [torch.nn.Linear(4, 64), torch.nn.Tanh(), torch.nn.Linear(64, 64), torch.nn.Tanh(), torch.nn.Linear(64, outputs)]
    return torch.nn.Sequential(*layers)


def advantages(rewards, values, dones, last, discount=0.99, decay=0.95):
    found, running = torch.zeros_like(rewards), torch.zeros(ENVS)
    for t in reversed(range(STEPS)):
        alive = 1 - dones[t]
        following = last if t + 1 == STEPS else values[t + 1]
        running = rewards[t] + discount * following * alive - values[t] + discount * decay * alive * running
        found[t] = running
    return found


def test_ppo_learns_to_balance_the_pole():
    torch.manual_seed(1)
    envs = gymnasium.make_vec("swm/CartPoleControl-v1", num_envs=ENVS, vectorization_mode="sync", max_episode_steps=200)
    envs = gymnasium.wrappers.vector.RecordEpisodeStatistics(envs)
    actor, critic = network(2), network(1)
    parameters = [*actor.parameters(), *critic.parameters()]
    optimizer = torch.optim.Adam(parameters, lr=1e-3, eps=1e-5)
    now, lengths = torch.from_numpy(envs.reset(seed=3)[0]).float(), []
    for _ in range(UPDATES):
        seen, acted, log_probs, rewards, dones, values = ([] for _ in range(6))
        for _ in range(STEPS):
            with torch.no_grad():
                policy = torch.distributions.Categorical(logits=actor(now))
                action, value = policy.sample(), critic(now).squeeze(1)
            observation, reward, terminated, truncated, info = envs.step(action.numpy())
            for store, item in ((seen, now), (acted, action), (log_probs, policy.log_prob(action)), (values, value)):
                store.append(item)
            rewards.append(torch.from_numpy(reward).float())
            dones.append(torch.from_numpy(terminated | truncated).float())
            now = torch.from_numpy(observation).float()
            if "episode" in info:
                lengths += info["episode"]["l"][info["_episode"]].tolist()
        rewards, values, dones = torch.stack(rewards), torch.stack(values), torch.stack(dones)
        with torch.no_grad():
            gain = advantages(rewards, values, dones, critic(now).squeeze(1))
        flat = [torch.stack(store).flatten(0, 1) for store in (seen, acted, log_probs)]
        gain, targets = gain.flatten(), (gain + values).flatten()
        for _ in range(4):
            for rows in torch.randperm(ENVS * STEPS).split(128):
                states, actions, before = (part[rows] for part in flat)
                policy = torch.distributions.Categorical(logits=actor(states))
                ratio = (policy.log_prob(actions) - before).exp()
                normal = (gain[rows] - gain[rows].mean()) / (gain[rows].std() + 1e-8)
                loss = -torch.min(ratio * normal, ratio.clamp(0.8, 1.2) * normal).mean()
                loss = loss + 0.5 * (critic(states).squeeze(1) - targets[rows]).square().mean() - 0.01 * policy.entropy().mean()
                optimizer.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(parameters, 0.5)
                optimizer.step()
    envs.close()
    first, final = sum(lengths[:20]) / 20, sum(lengths[-20:]) / 20
    assert final > 2 * first, (first, final)
