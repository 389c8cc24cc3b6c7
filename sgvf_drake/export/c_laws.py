"""The constants of the laws, as the templates of their C code take them."""

from functools import cache

from sgvf_drake.export.c_numbers import literal


@cache
def laws_constants() -> dict[str, str]:
    """Returns the constants by their names in the templates."""
    # Imported here: fields alone do without Drake.
    from systems import QuadrotorParameters, course_controller, se3_law
    from systems.controller import DEFAULT_GAINS

    vehicle = QuadrotorParameters()
    rotors = vehicle.rotors
    inertia = ", ".join(map(literal, vehicle.inertia))
    parts = [
        literal(vehicle.mass),
        "{" + inertia + "}",
        *map(literal, (*rotors, vehicle.gravity)),
    ]
    numbers = {
        "least_progress": course_controller.LEAST_PROGRESS,
        "standing": course_controller.STANDING,
        "min_lift": se3_law.MIN_LIFT,
        "lift_share": se3_law.LIFT_SHARE,
        "thrust_share": se3_law.THRUST_SHARE,
        "max_rate": se3_law.MAX_DESIRED_RATE,
        "max_angular_acceleration": se3_law.MAX_DESIRED_ANGULAR_ACCELERATION,
        "max_heading_error": se3_law.MAX_HEADING_ERROR,
        "slow_speed": se3_law.SLOW_SPEED,
        "max_tilt": se3_law.MAX_TILT,
    }
    return {
        **{name: literal(value) for name, value in numbers.items()},
        "vehicle": ", ".join(parts),
        "gains": ", ".join(map(literal, DEFAULT_GAINS[:4])),
    }
