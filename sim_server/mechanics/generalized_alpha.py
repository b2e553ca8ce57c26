# SPDX-License-Identifier: MIT
"""The generalized-alpha method: balance of momentum at a point within the step, with numerical damping as asked for.

With f the forces, M the masses, h the time step, a the acceleration that the scheme carries on, a prime for the end of
the step and a bar for the generalized mid point, x_bar = x + (1 - alpha_f) (x' - x), v_bar likewise,

    M ((1 - alpha_m) a' + alpha_m a) = f(x_bar, v_bar)
    x' = x + h v + h^2 ((1/2 - beta) a + beta a'),    v' = v + h ((1 - gamma) a + gamma a')

and, with the spectral radius rho at infinite frequency, from 0 to 1,

    alpha_m = (2 rho - 1) / (1 + rho),    alpha_f = rho / (1 + rho)
    beta = (1 - alpha_m + alpha_f)^2 / 4,    gamma = 1/2 - alpha_m + alpha_f

for order 2, stability at every h, and the least damping of low frequencies for that of high ones. rho = 1 is the
implicit mid-point rule, rho = 0 removes the highest frequencies in one step.

The forces are those of the averaged state, not the average of the forces of both ends. With one linearization the two
are the same; with several the mid point needs no forces of the step before, which nobody keeps, and with rho = 1 keeps
the angular momentum of a free body, which averaged forces do not (Simo, Tarnow and Wong 1992).

A step solves for dv = v_bar - v, and so has the form of integrator.py with the bar in place of the prime there:

    c = beta h / gamma,    i = gamma h (1 - alpha_f) / (1 - alpha_m)
    p = (1 - alpha_f) ((gamma / beta) v + h (gamma / (2 beta) - 1) a)
    r = R h a,    R = (1 - alpha_f) (1 - alpha_m - gamma) / (1 - alpha_m)

Effects and Newton-Raphson know nothing of it: they assemble at x_bar what they assemble at x' elsewhere. Then

    v' = v + dv / (1 - alpha_f),    x' = x + c (p + dv) / (1 - alpha_f)
    r' = (1 - alpha_m - gamma) / (gamma (1 - alpha_m)) (dv - r) - alpha_m / (1 - alpha_m) r
    p' = (1 - alpha_f) (gamma / beta) v' + Q r',    Q = -s (1 + 3 s) / (1 + s)^2,    s = gamma - 1/2

since i (1 - alpha_m) a' + i alpha_m a = dv - r. Q is the factor of h a in p over R; with rho = 1 both, and r, are 0.

Sources: Chung and Hulbert, J. Appl. Mech. 60, 1993; Erlicher, Bonaventura and Bursi, Comput. Mech. 28, 2002 (nonlinear
forces); Simo, Tarnow and Wong, Comput. Methods Appl. Mech. Eng. 100, 1992 (momenta).
"""

from sim_server.backends.base import Launch
from sim_server.mechanics.integrator import InitialWeights, Integrator, PredictorWeights
from sim_server.mechanics.system import System
from sim_server.scene import Scene


class GeneralizedAlphaIntegrator(Integrator):
    """The launches of the generalized-alpha method."""

    def __init__(self, scene: Scene, system: System):
        super().__init__(scene, system)
        a, h = self.options.alpha, self.world.dt
        self._inertia_of = (1 - a.alpha_f) * (1 - a.alpha_m - a.gamma) / (1 - a.alpha_m)  # R
        self._from_velocity = (1 - a.alpha_f) * a.gamma / a.beta
        curved = (1 - a.alpha_f) * (0.5 * a.gamma / a.beta - 1)  # h a in p
        self._initial = InitialWeights(self._from_velocity, h * curved, h * self._inertia_of)
        # After a step of backward Euler a = dv / h, and the kernel takes dv i / h for dv - r (integrator.py).
        from_force = curved * h / self.world.force_coefficient
        self._weights = PredictorWeights(
            from_velocity=self._from_velocity, from_force=from_force, inertia_from_dv=self._inertia_of
        )

    def advance(self) -> list[Launch]:
        """Advances the state by the solution, on from the generalized mid point to the end of the step."""
        s, w, a = self.system, self.world, self.options.alpha
        damped = a.gamma - 0.5
        advance = self._bind(
            "advance_generalized_alpha", rotation=s.rotation, y=s.y, beta=self.beta, dx_dv=w.dx_dv, v=w.v, x=w.x,
            dv=s.dv, inertial_increment=self.inertial_increment, predictor=w.predictor,
            damping_velocity=w.damping_velocity, before=self.before, whole=1 / (1 - a.alpha_f),
            from_velocity=self._from_velocity, from_inertia=-damped * (1 + 3 * damped) / (1 + damped) ** 2,
            inertia_from_force=(1 - a.alpha_m - a.gamma) / (a.gamma * (1 - a.alpha_m)),
            inertia_from_inertia=-a.alpha_m / (1 - a.alpha_m),
        )  # fmt: skip
        return [advance]
