"""The vehicle of `QuadrotorParameters` in the words of RotorPy (Folk, Paulos, Kumar 2023)."""

import numpy as np

from systems import QuadrotorParameters

# RotorPy counts forces in squares of rotor speeds; any constant gives the same flight.
THRUST_COEFFICIENT = 1e-6
# The "+" layout of QuadrotorPlant.
ROTOR_DIRECTIONS = ((1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0))


def rotorpy_parameters(gains, vehicle=None):
    """RotorPy's parameters of a vehicle without drag, with the gains of our attitude loop."""
    vehicle = vehicle or QuadrotorParameters()
    Ixx, Iyy, Izz = vehicle.inertia
    no_drag = dict.fromkeys(("c_Dx", "c_Dy", "c_Dz", "k_d", "k_z", "k_h", "k_flap"), 0.0)
    return {
        "mass": vehicle.mass,
        **{"Ixx": Ixx, "Iyy": Iyy, "Izz": Izz, "Ixy": 0.0, "Ixz": 0.0, "Iyz": 0.0},
        "num_rotors": 4,
        "rotor_pos": {
            f"r{i}": vehicle.arm_length * np.array(direction, float)
            for i, direction in enumerate(ROTOR_DIRECTIONS, start=1)
        },
        "rotor_directions": np.array([1, -1, 1, -1]),
        "k_eta": THRUST_COEFFICIENT,
        "k_m": vehicle.yaw_arm * THRUST_COEFFICIENT,
        **no_drag,
        "tau_m": np.inf,
        "rotor_speed_min": 0.0,
        "rotor_speed_max": np.sqrt(vehicle.max_propeller_force / THRUST_COEFFICIENT),
        "motor_noise_std": 0.0,
        "kp_att": gains.attitude_bandwidth**2,
        "kd_att": 2.0 * gains.damping_ratio * gains.attitude_bandwidth,
    }
