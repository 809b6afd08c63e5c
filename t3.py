import warnings; warnings.filterwarnings("ignore")
from recrl.environments.registry import make_vector
for o in ({"id":"Pendulum-v1","keywords":{"gg":1},"costless":True},{"id":"Pendulum-v1","keywords":{"g":9.0,"max_episode_steps":50},"costless":True},{"id":"HalfCheetah-v5","keywords":{"frame_skp":3},"costless":True},{"id":"HalfCheetah-v5","keywords":{"disable_env_checker":True},"costless":True},{"id":"CartPole","costless":True}):
    try: make_vector("gymnasium",1,options=o).close(); print(o,"ok")
    except Exception as e: print(o, type(e).__name__, e)
import pandas as pd, math
from recrl.analysis.statistics import claims
from recrl.analysis.data import sweep_data
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.analysis.statistics import metrics
from pathlib import Path
s=sweep_data.load(SweepStore(Path("/tmp/rev"),"empty"))
print(list(s.trials.columns))
try: print(claims.count_claims(metrics.outcomes(s), metrics.training_totals(s), s.trials).shape)
except Exception as e: print("claims empty:",type(e).__name__,e)
from recrl.analysis.report.verdict_table import verdict_text, cost_title
from recrl.analysis.data.number_texts import number, with_error
print(number(1e-9), number(99.999), number(0.09999), number(math.inf), number(-math.inf), with_error(0.0004,0.0002,digits=3))
from recrl.analysis.statistics.intervals import paired_difference
import numpy as np
print(paired_difference(np.full(3,.02),np.zeros(3),tie=.1) if 'tie' in paired_difference.__code__.co_varnames else None)
