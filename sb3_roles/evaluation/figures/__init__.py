"""The figures of a plan, and the numbers behind them."""
