"""Andrews' squeezing mechanism
============================

Seven bodies, driven by a torque and held by a spring, in joint angles with three closed loops: a well-known test for
solvers of differential-algebraic equations of index 3. Here an explicit method solves it. The angles at t = 0.03 s are
known.

Source: E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, section VII.7; data and solution from
F. Mazzia, C. Magherini, Test Set for Initial Value Problem Solvers, 2008, chapter II-9.
"""

import matplotlib.pyplot as plt
import numpy as np

import invariode as iv

# lengths of the bodies and places of the fixed points A, B and C, in metres
A, B, C = np.array([-0.06934, -0.00227]), np.array([-0.03635, 0.03273]), np.array([0.014, 0.072])
D, DA, E, EA, RR, RA = 0.028, 0.0115, 0.02, 0.01421, 0.007, 0.00092
SS, SA, SB, SC, SD = 0.035, 0.01874, 0.01043, 0.018, 0.02
TA, TB, U, UA, UB, ZF, ZT, FA = 0.02308, 0.00916, 0.04, 0.01228, 0.00449, 0.02, 0.04, 0.01421
# torque, stiffness and length of the spring, masses and moments of inertia
TORQUE, STIFFNESS, REST = 0.033, 4530.0, 0.07785
M2, M4, M6 = 0.00365, 0.00706, 0.00706
I1, I2, I3 = 0.04325 * RA**2 + 2.194e-6, 4.410e-7, 0.02373 * (SA**2 + SB**2) + 5.255e-6
I4, I5, I6, I7 = 5.667e-7, 0.07050 * (TA**2 + TB**2) + 1.169e-5, 5.667e-7, 0.05498 * (UA**2 + UB**2) + 1.912e-5

START = [-0.0617138900142765, 0, 0.455279819163070, 0.222668390165886, 0.487364979543843, -0.222668390165886]
START += [1.23054744454982]
END = [15.81077119629904, -15.75637105984298, 0.04082224013073101, -0.5347301163226948, 0.5244099658805304]
END += [0.5347301163226948, 1.048080741042263]


def mass(t, q):
    _, theta, _, phi, _, omega, _ = q
    m, four, six = np.zeros((7, 7)), E - EA, ZF - FA
    m[0, 0] = I1 + I2 + M2 * (RR**2 - 2 * DA * RR * np.cos(theta) + DA**2)
    m[0, 1] = m[1, 0] = I2 + M2 * (DA**2 - DA * RR * np.cos(theta))
    m[1, 1], m[2, 2] = I2 + M2 * DA**2, I3
    m[3, 3] = I4 + M4 * four**2
    m[3, 4] = m[4, 3] = I4 + M4 * (four**2 + ZT * four * np.sin(phi))
    m[4, 4] = I4 + I5 + M4 * (ZT**2 + 2 * ZT * four * np.sin(phi) + four**2)
    m[5, 5] = I6 + M6 * six**2
    m[5, 6] = m[6, 5] = I6 + M6 * (six**2 - U * six * np.sin(omega))
    m[6, 6] = I6 + I7 + M6 * (six**2 - 2 * U * six * np.sin(omega) + U**2)
    return m


def force(t, q, v):
    _, theta, gamma, phi, _, omega, _ = q
    beta_, theta_, _, phi_, delta_, omega_, epsilon_ = v
    arm = np.array([SD * np.cos(gamma) + SC * np.sin(gamma), SD * np.sin(gamma) - SC * np.cos(gamma)])
    spring = B + arm - C
    length = np.hypot(*spring)
    pull = -STIFFNESS * (length - REST) / length * spring
    two, four, six = M2 * DA * RR * np.sin(theta), M4 * ZT * (E - EA) * np.cos(phi), M6 * U * (ZF - FA) * np.cos(omega)
    return [
        TORQUE - two * theta_ * (theta_ + 2 * beta_),
        two * beta_**2,
        arm[0] * pull[1] - arm[1] * pull[0],
        four * delta_**2,
        -four * phi_ * (phi_ + 2 * delta_),
        -six * epsilon_**2,
        six * omega_ * (omega_ + 2 * epsilon_),
    ]


def towards(angle, across=0):
    """A unit vector in the plane, or the one to its right."""
    return np.array([np.sin(angle), -np.cos(angle)]) if across else np.array([np.cos(angle), np.sin(angle)])


def loops(t, q):
    """The point where three chains of bodies meet, from the crank and from each chain."""
    beta, theta, gamma, phi, delta, omega, epsilon = q
    meeting = RR * towards(beta) - D * towards(beta + theta)
    ends = [
        B + SS * towards(gamma, across=1),
        A + E * towards(phi + delta, across=1) + ZT * towards(delta),
        A + ZF * towards(omega + epsilon) + U * towards(epsilon, across=1),
    ]
    return np.concatenate([meeting - end for end in ends])


def joints(t, q):
    beta, theta, gamma, _, delta, _, epsilon = q
    crank = RR * towards(beta)
    meeting = crank - D * towards(beta + theta)
    hook = B + SD * towards(gamma) + SC * towards(gamma, across=1)
    return [[0, 0], crank, meeting, B, hook, C, A, A + ZT * towards(delta), A + U * towards(epsilon, across=1)]


LINKS = [(0, 1, 2), (3, 2), (3, 4, 2), (4, 5), (6, 7, 2), (6, 8, 2)]


def main():
    machine = iv.MechanicalSystem(mass, force, loops, points=joints, name="squeezing mechanism")
    figure, (picture, errors) = plt.subplots(1, 2, figsize=(9.6, 4.2), layout="constrained")
    for label, correction in (("plain", "none"), ("projected", "levels")):
        problem = machine.problem((0, 0.03), START, np.zeros(7), correction=correction)
        sol = problem.solve("dop853", rtol=1e-6, atol=1e-6, dense_output=True)
        off = [np.abs(loops(0, q)).max() / RR for q in sol.y[:7].T]
        digits = -np.log10(np.abs(sol.y[:7, -1] / END - 1).max())
        print(f"{label:>9}: loops off by {max(off):.1e} of the crank, {digits:.1f} digits, {sol.nfev} evaluations")
        errors.semilogy(1e3 * sol.t[1:], np.array(off[1:]) + 1e-17, lw=0.9, label=label)
    for k, t in enumerate((0.0, 0.0133, 0.0147)):
        where = np.array(joints(t, sol.sol(t)[:7]))
        for link in LINKS:
            picture.plot(*where[list(link)].T, "o-", color=f"C{k}", ms=3, lw=1.2, alpha=0.8)
    picture.plot(*np.transpose([A, B, C, [0, 0]]), "k^", ms=7)
    picture.set(xlabel="x in m", ylabel="y in m", title="At 0, 13.3 and 14.7 ms", aspect="equal")
    errors.set(xlabel="t in ms", title="Loops open by, in units of the crank")
    errors.legend()
    return figure


if __name__ == "__main__":
    main()
    plt.show()
