import sys, tempfile, pathlib, errno, os
sys.path.insert(0,"/work/main")
from tests.conftest import MadeUpSweep
from tests.orchestrator.test_tracking import SMALL, NONE, DYNAMIC, runs, trial_titled
from recrl.orchestrator.tracking import mlflow_sync
from recrl.orchestrator.tracking.client import tracking_uri
from recrl.orchestrator.tracking.mlflow_sync import sync
import logging; logging.disable(logging.INFO)
root=pathlib.Path(tempfile.mkdtemp(dir="/tmp/rev"))
store=MadeUpSweep(**SMALL).write(root,"a")
uri=tracking_uri(store,None)
t=trial_titled(store,NONE)
whole=t.episodes_path.read_bytes()
t.episodes_path.write_bytes(whole[:-9])
r=sync(store,uri); print("1 damaged at first pass:",r)
run=runs(store)[NONE]; print(run.info.status, len(run.data.params), run.data.tags.get("recrl.group"), run.info.start_time)
t.episodes_path.write_bytes(whole)
r=sync(store,uri); run=runs(store)[NONE]
print("2 mended, new process:",r.problem, run.info.status,"params",len(run.data.params), "other params", len(runs(store)[DYNAMIC].data.params), run.data.tags.get("recrl.group"))
# spec damaged after summary
tr=mlflow_sync.Tracker(store,uri)
print(tr.bring_up_to_date(live=True))
sp=t.spec_path.read_bytes(); t.spec_path.write_bytes(sp[:-20])
for _ in range(2):
    print("3 spec damaged:",tr.bring_up_to_date(live=True))
print(runs(store)[NONE].info.status)
t.spec_path.write_bytes(sp)
print("4 mended", tr.bring_up_to_date(live=True).problem)
# note after damage
t.episodes_path.write_bytes(whole[:-9])
tr.bring_up_to_date(live=True)
print(runs(store)["a"].data.tags["mlflow.note.content"])
t.episodes_path.write_bytes(whole)
# transient read error
from recrl.orchestrator.files import row_files
from recrl.orchestrator.files.trial_store import TrialStore
old=pathlib.Path.open
def bad(self,*a,**k):
    if self.name=="episodes.csv": raise OSError(errno.EIO,os.strerror(errno.EIO))
    return old(self,*a,**k)
pathlib.Path.open=bad
try:
    t2=TrialStore(t.folder)
    print("damages",t2.damages())
    rec=t2.verified_record(); print(rec.status,rec.is_left_alone,rec.error)
    try: t2.require_whole()
    except Exception as e: print(type(e).__name__, e)
    from recrl.orchestrator.launch_plan import make_plan, TrialSelection
    print([p.action for p in make_plan(store.specs(),store,TrialSelection(rerun_damaged=True)).trials])
finally: pathlib.Path.open=old
