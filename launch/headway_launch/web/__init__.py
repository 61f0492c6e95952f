"""The pages that `headway browse` serves: studies, their reports, and the MLflow UI."""
