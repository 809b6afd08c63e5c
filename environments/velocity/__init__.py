"""Safety-Gymnasium's velocity tasks: MuJoCo robots that earn by running and pay for running too fast.

Importing this registers them with Gymnasium as ``recrl/SafetyAntVelocity-v1`` and so on: that is what
``gymnasium.make("recrl.environments.velocity:recrl/SafetyAntVelocity-v1")`` relies on.

Modules: ``tasks`` (numbers), ``model`` (Gymnasium's models), ``physics`` (the compiled step), ``worlds`` (a
batch of robots), ``environments`` (for Gymnasium and for agents), ``rendering``, ``parity``,
``registration``.
"""

from recrl.environments.velocity.registration import register_velocity

register_velocity()
