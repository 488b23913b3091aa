import numpy as np, kalmark as km
from kalmark.config import build_slam
from kalmark.simulate import load_world, simulate
print([n for n in dir(km.association) if n[0].isupper()])
world = load_world("random_field", ["steps=300"]); log = simulate(world, seed=4)
for s,b in ((0.033,.02),(.1,.02),(.3,.02)):
    key = "filter.robots.rover.sensors.lidar"
    said = [f"{key}.sigma_range_m={s}", f"{key}.sigma_bearing_rad={b}", "steps=300"]
    run = km.record(build_slam(load_world("random_field", said).config(), log), log, progress=False, pictures=False)
    t=run.evaluate(); print(s,b,round(t['nis_per_dof'],2), round(t["robots"]["rover"]["pose_nees"],1))
world = load_world("random_field", ["steps=300", "ids=false"]); log = simulate(world, seed=1)
for name,a in {"nearest":km.association.NearestNeighbour(),"auto":km.association.Automatic(),"jcbb":km.association.JCBB() if hasattr(km.association,'JCBB') else None}.items():
    run = km.record(build_slam(world.config(), log, association=a), log, progress=False, pictures=False); t=run.evaluate()
    print(name,len(run.final_slam().landmarks()), {k:t[k] for k in ("associated", "new", "deferred", "tentative", "ignored")})
for c in (200,400):
    world = load_world("random_field", ["steps=300", "ids=false", f"world.count={c}"]); log = simulate(world, seed=1)
    for name,a in {"nearest":km.association.NearestNeighbour(),"auto":km.association.Automatic()}.items():
        run = km.record(build_slam(world.config(), log, association=a), log, progress=False, pictures=False); t=run.evaluate()
        print(c,name,len(run.final_slam().landmarks()), {k:t[k] for k in ("associated", "new", "deferred", "tentative", "ignored")}, t.get('landmark_rmse_m'))
