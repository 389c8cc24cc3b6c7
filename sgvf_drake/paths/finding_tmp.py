import numpy as np
from scipy.spatial import cKDTree
from sgvf_drake.paths.ridge import find_ridge, thin
from sgvf_drake.paths.skeleton import grow_skeleton
from sgvf_drake.paths.assembly import assemble
def ladder(P):
    P=P[np.lexsort(P.T)]
    W=np.ones(len(P))
    d=cKDTree(P).query(P,k=min(4,len(P)))[0][:,-1]; sp=np.median(d)/1.5
    s=max(.02,.7*sp); out=[]
    while s<max(.75,3*s if not out else 0):
        r=find_ridge(P,W,s); g=grow_skeleton(r.points,P,W,s); out.append((s,assemble(g,s),r)); s*=2**.25
    return out
