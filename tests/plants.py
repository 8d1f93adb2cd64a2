"""Plants of both orders, from swinging to sluggish, as hypothesis draws them."""

from hypothesis import strategies as st

from pumafuse import FirstOrder, SecondOrder

PLANT = st.one_of(
    st.builds(lambda tau: FirstOrder(time_constant=tau), st.floats(1e-3, 1.0)),
    st.builds(
        lambda omega, damping: SecondOrder(natural_frequency=omega, damping=damping),
        st.floats(2.0, 500.0),
        st.one_of(st.floats(0.05, 0.95), st.floats(0.95, 1.05), st.just(1.0), st.floats(1.05, 8.0)),
    ),
)
