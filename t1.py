"""crpo: reward step blocked by violated cost without influence"""
import numpy as np
from recrl.agents.algorithms.crpo import reward_step, overshoot, most_violated
from recrl.agents.algorithms.own_options import CRPOConfig
from recrl.agents.trust_region.cpo_dual import StepProblem
import inspect
print(inspect.signature(StepProblem))
c=CRPOConfig(); print(c.kl_penalty)
for g in (0.0, 1e-13):
  for m in (0.0,-1e-8):
    p=StepProblem(1.0, np.array([m]), np.array([[g]]), np.array([5.0]), 0.01)
    print(g,m,reward_step(p,c).gradient_weight, overshoot(p,c))
for k in (1,10,100.):
    c=CRPOConfig(kl_penalty=k)
    p=StepProblem(1e-4, np.array([-1e-9]), np.array([[1e-13]]), np.array([5.0]), 0.01)
    print(k, reward_step(p,c).gradient_weight, np.sqrt(2*0.01/1e-4))
