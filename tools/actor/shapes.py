from dataclasses import dataclass
import numpy as np
@dataclass(frozen=True, eq=False)
class Shapes:
    deltas: object
    names: tuple
    gaze: object
    def jaw_deltas(self, p): return np.zeros((1,len(p),3))
def make_shapes(lattice, sculpture, who):
    return Shapes(np.zeros((1,len(lattice.row),3)),("jawOpen",),np.zeros((2,1,2)))
