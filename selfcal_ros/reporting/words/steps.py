# SPDX-License-Identifier: Apache-2.0
"""Next steps of a plan, and how the best plan was searched, in words."""

from selfcal_ros.estimation.observability.plan_check import describe_view
from selfcal_ros.estimation.observability.suggest import Search, Suggestion
from selfcal_ros.model.view import Plan


def step_text(step: Suggestion, plan: Plan) -> str:
    """Return what a suggestion asks for.

    Parameters
    ----------
    step : Suggestion
        One of `rank_next`.
    plan : Plan
        The plan that it is a next step of.
    """
    if step.view is None:
        pairs = {(old.repeats, new.repeats)
                 for old, new in zip(plan.views, step.views, strict=True)}
        return f"visit the marks in the order {step.order}" + "".join(
            f", {new} repeats for {old}" for old, new in sorted(pairs) if new != old)
    if step.repeat_of is None:
        return "add " + describe_view(step.view, plan.artifact)
    before = plan.views[step.repeat_of]
    return f"measure view '{before.name}' {step.view.repeats} times, not {before.repeats}"


def search_text(search: Search) -> str:
    """Return how the best plan was searched."""
    how = ("greedy choice, then exchange of single views" if search.n_plans is None
           else f"all {search.n_plans} plans tried")
    size = search.size
    return how if size is None else f"{how} on a field of {size} x {size} sites"
