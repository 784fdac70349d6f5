"""A fit to lynx and hare
======================

Pelts that the Hudson's Bay Company bought in twenty-one years, hare and lynx in thousands. Lotka and Volterra's
equations are fitted to them with their initial values and the relative error of the data, which is log-normal; the
bands contain 95 % of such data. Each run of the search stays on its closed orbit.

Source: C. Gordon Hewitt, The Conservation of the Wild Life of Canada (1921); the table is that of J. M. Mahaffy, and
the model that of B. Carpenter, Predator-prey population dynamics: the Lotka-Volterra model in Stan (2018).
"""

import matplotlib.pyplot as plt
import numpy as np

import invariode as iv

years = np.arange(1900, 1921)
hare = [30, 47.2, 70.2, 77.4, 36.3, 20.6, 18.1, 21.4, 22, 25.4, 27.1, 40.3, 57, 76.6, 52.3, 19.5, 11.2, 7.6, 14.6, 16.2,
        24.7]  # fmt: skip
lynx = [4, 6.1, 9.8, 35.2, 59.4, 41.7, 19, 13, 8.3, 9.1, 7.4, 8, 12.3, 19.5, 45.7, 51.1, 29.7, 15.8, 9.7, 10.1, 8.6]


def predator_prey(t, y, birth, hunting, death, growth):
    prey, predators = y
    return [birth * prey - hunting * prey * predators, -death * predators + growth * prey * predators]


def orbit(t, y, birth, hunting, death, growth):
    prey, predators = y
    return growth * prey - death * np.log(prey) + hunting * predators - birth * np.log(predators)


def main():
    problem = iv.Problem(
        predator_prey, (1900, 1920), [30.0, 4.0], args=(0.5, 0.03, 0.8, 0.03), invariants=orbit, labels=["hare", "lynx"]
    )
    positive = iv.Parameter(scale="log")
    names = ["birth", "hunting", "death", "growth", "y0[hare]", "y0[lynx]", "error"]
    data = {"hare": hare, "lynx": lynx}
    fit = iv.fit(problem, years, data, dict.fromkeys(names, positive), sigma="error", noise="lognormal")
    print(fit)
    print(f"orbit off by {np.abs(fit.solution.residual).max():.1e}")
    figure, axes = plt.subplots(2, sharex=True, layout="constrained")
    band = fit.predict(np.linspace(1900, 1920, 300), noise=True)
    for i, (ax, name) in enumerate(zip(axes, band.names, strict=True)):
        ax.fill_between(band.t, band.lower[i], band.upper[i], color=f"C{i}", alpha=0.2, lw=0)
        ax.plot(band.t, band.y[i], color=f"C{i}")
        ax.plot(years, data[name], "o", color=f"C{i}", mfc="none")
        ax.set_ylabel(f"{name} (thousands)")
    axes[0].set_title("Lynx and hare, with 95 % bands")
    axes[1].set_xlabel("year")
    axes[1].set_xticks(range(1900, 1921, 5))
    return figure


if __name__ == "__main__":
    main()
    plt.show()
