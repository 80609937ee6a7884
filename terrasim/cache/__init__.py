"""What is resident: pool, pointer tables, needs, jobs, and the ground behind them."""
