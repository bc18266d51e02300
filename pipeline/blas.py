"""Linear algebra of small matrices on one thread.

On matrices of some hundred rows the threads of a BLAS gain little, and where other programs use the processors they
wait for each other many times longer than they compute. The last digits, too, hang on the number of threads.
"""

from threadpoolctl import threadpool_limits

on_one_thread = threadpool_limits.wrap(limits=1, user_api="blas")
"""Decorates a function within which BLAS computes on one thread."""
