"""The messages between host and bench, and the clock behind them."""
