"""Train a network that generates poses, with a loss that keeps them from colliding.

The network turns noise into latent codes that are spread more widely than the training poses'. Its
loss is the distance of their mean and spread from that and, above the decision threshold, the
collision logit. Try --weight 0 to see what the logit is for.

python collision_loss.py body --steps 200
"""

import argparse

import torch

from lcollision_core.bodies import LearnedBody, check_poses

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("model", help="a model with a predictor")
parser.add_argument("--steps", type=int, default=200)
parser.add_argument("--spread", type=float, default=1.5, help="of the codes, 1 the training poses'")
parser.add_argument("--weight", type=float, default=0.1, help="of the collision loss")
arguments = parser.parse_args()

torch.manual_seed(0)
model = LearnedBody.load(arguments.model)
module = model.torch_module()
known = torch.tensor(model.known_poses, dtype=torch.float32)
mean, deviation = known.mean(dim=0), arguments.spread * known.std(dim=0)
network = torch.nn.Sequential(
    torch.nn.Linear(16, 64), torch.nn.SiLU(), torch.nn.Linear(64, module.latent_size)
)
optimiser = torch.optim.Adam(network.parameters(), lr=1e-2)
for step in range(arguments.steps + 1):
    codes = network(torch.randn(64, 16))
    colliding = torch.relu(module.logit(mean + deviation * codes)).mean()
    likeness = codes.mean(dim=0).square().mean() + (codes.std(dim=0) - 1.0).square().mean()
    optimiser.zero_grad()
    (likeness + arguments.weight * colliding).backward()
    optimiser.step()
    if step % 50 == 0:
        poses = (mean + deviation * codes.detach()).numpy()
        share = check_poses(model, poses).colliding.mean()
        print(f"step {step}: likeness {likeness.item():.3f}, {100 * share:.0f} % collide (checked)")
