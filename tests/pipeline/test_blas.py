from threadpoolctl import threadpool_info, threadpool_limits

from greenough.pipeline.blas import on_one_thread


def threads() -> set[int]:
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def test_blas_computes_on_one_thread_within_and_as_before_after():
    with threadpool_limits(2, user_api="blas"):
        assert threads() == {2}
        assert on_one_thread(threads)() == {1}
        assert threads() == {2}
