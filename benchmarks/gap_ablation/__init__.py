"""Ablation of the thresholds of `gap`: which answers change if the rule behind a threshold never acts."""
